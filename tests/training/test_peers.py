"""Training of learned methods, with a method of a few weights that learns simulated places."""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import write_json
from sglpr_jax.methods.learned.method import LearnedMethod, triplet
from sglpr_jax.methods.learned.trained import load_variables, random_variables, save_variables
from sglpr_jax.methods.recipe import Recipe, TupleConfig
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.peer_inputs import prepare_inputs
from sglpr_jax.training.peers import (
    HeldOutScore,
    PeerBatch,
    PeerNetwork,
    RunSettings,
    best_rate,
    train_learned,
    variables_of,
)
from sglpr_jax.training.step import train_step
from sglpr_jax.training.validation import require_revisits

SECTORS = 24
MINED = TupleConfig(positives=1, negatives=2, revisit_gap=5, mining="hardest", hardest=4, refresh_steps=4)


def ranges(scan: Scan) -> np.ndarray:
    """The nearest point of each of 24 sectors, in units of 20 m."""
    x, y, _ = scan.upright_points.T
    sector = ((np.arctan2(y, x) + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    found = np.full(SECTORS, 60, np.float32)
    np.minimum.at(found, sector, np.hypot(x, y))
    return found / 20


class Rings(nn.Module):
    normalised: bool = True

    @nn.compact
    def __call__(self, inputs, *, train):
        x = nn.Dense(16)(inputs)
        x = nn.BatchNorm(use_running_average=not train)(x) if self.normalised else x
        return nn.Dense(8)(nn.relu(x))


def roll_azimuths(key, inputs):
    by = jax.random.randint(key, (len(inputs),), 0, 2)
    return jax.vmap(jnp.roll)(inputs, by)


TINY = LearnedMethod(
    name="tiny",
    source="this test",
    licence="MIT",
    takes="points",
    weights=24 * 16 + 16 + 32 + 16 * 8 + 8,
    network=Rings(),
    prepare=ranges,
    rotate_inputs=roll_azimuths,
    loss=functools.partial(triplet, margin=0.5, closest_positive=True, reduction="sum"),
    recipe=Recipe(
        sampling=TupleConfig(positives=1, negatives=2, revisit_gap=5),
        tuples=10,
        learning_rates=(1e-6, 1e-2, 2e-2),
        weight_decay=1e-3,
    ),
)


def loop(name: str, seed: int, *, scans: int = 60) -> Recording:
    """Two laps of a square; each place is a circle of points with the ranges of that place, and some noise."""
    rng = np.random.default_rng(seed)
    way = np.arange(scans) % (scans // 2)
    along = way / (scans // 2) * 2 * np.pi
    positions = np.stack([50 * np.cos(along), 50 * np.sin(along), 0 * along], axis=1)
    reach = rng.uniform(5, 50, (scans // 2, SECTORS))[way] + rng.normal(0, 0.5, (scans, SECTORS))
    angle = (np.arange(SECTORS) + 0.5) / SECTORS * 2 * np.pi - np.pi
    clouds = np.stack([reach * np.cos(angle), reach * np.sin(angle), 0 * reach], axis=-1).astype(np.float32)

    def read(path, labels):
        return Scan(points=np.repeat(clouds[int(path.stem)], 20, axis=0))

    return Recording(
        name=name,
        ids=tuple(f"{i:06d}" for i in range(scans)),
        positions=positions,
        times=np.arange(scans) * 2.0,
        pose_source="this test",
        paths=tuple(Path(f"{i:06d}.bin") for i in range(scans)),
        read=read,
        on_disk=False,
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return prepare_inputs(TINY, [loop("a", 0), loop("b", 1)], tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def held_out(tmp_path_factory):
    return prepare_inputs(TINY, [loop("c", 2)], tmp_path_factory.mktemp("cache"))


def settings(**more) -> RunSettings:
    return RunSettings(**{"learning_rate": 1e-2, "seconds": 600.0, "images": 1200, **more})


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_inputs_are_prepared_once_and_by_method_and_recording(tmp_path):
    recording, counted = loop("a", 0), []

    def counting(scan):
        counted.append(scan.name)
        return ranges(scan)

    method = dataclasses.replace(TINY, prepare=counting)
    first = prepare_inputs(method, [recording], tmp_path)
    again = prepare_inputs(method, [recording], tmp_path)
    assert len(counted) == 60 and isinstance(again.inputs[0], np.memmap)
    np.testing.assert_array_equal(first.inputs[0], np.stack([ranges(recording.scan(i)) for i in range(60)]))
    prepare_inputs(dataclasses.replace(method, name="other"), [recording], tmp_path)
    bad = dataclasses.replace(loop("c", 1), read=lambda *_: Scan(points=np.zeros((0, 3), "f4")))
    with pytest.raises(ValueError, match="scan 000000 of sequence c"):
        prepare_inputs(method, [loop("b", 0), bad], tmp_path)
    assert len(counted) == 180 and sorted(path.name[:6] for path in tmp_path.iterdir()) == [
        "other-",
        "tiny-a",
        "tiny-b",
    ]


def test_recordings_that_do_not_fit_are_errors(tmp_path):
    odd = dataclasses.replace(TINY, prepare=lambda scan: ranges(scan)[: 23 if "000007" in scan.name else 24])
    with pytest.raises(ValueError, match=r"scan 000007 of sequence a: expected an input float32 \(24,\).*\(23,\)"):
        prepare_inputs(odd, [loop("a", 0)], tmp_path)
    with pytest.raises(ValueError, match="sequence a has no poses"):
        prepare_inputs(TINY, [dataclasses.replace(loop("a", 0), positions=None)], tmp_path)
    with pytest.raises(ValueError, match="tiny needs labels beside the scans, found none in sequence a"):
        prepare_inputs(dataclasses.replace(TINY, takes="labelled points"), [loop("a", 0)], tmp_path)
    with pytest.raises(ValueError, match="tiny needs points, found only images in sequence a"):
        prepare_inputs(TINY, [dataclasses.replace(loop("a", 0), resolution_m=0.4)], tmp_path)
    straight = dataclasses.replace(loop("c", 2), positions=np.arange(60.0)[:, None] * [10, 0, 0])
    with pytest.raises(ValueError, match="sequence c: expected revisits within 5 m"):
        require_revisits([straight])
    sparse = prepare_inputs(TINY, [straight], tmp_path / "cache")
    with pytest.raises(ValueError, match="expected frames within"):
        train_learned(TINY, sparse, settings(), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_step_is_that_of_adam_with_weight_decay():
    """The first step of Adam moves every weight by the learning rate, against the sign of the decayed gradient."""
    network = PeerNetwork(TINY, seed=5)
    before = network.new_state(0.01)
    rng = np.random.default_rng(0)
    batch = PeerBatch(rng.normal(size=(12, SECTORS)).astype(np.float32), np.zeros((4, 3), np.float32))
    after, metrics = train_step(jax.tree.map(jnp.copy, before), batch, network=network)
    assert int(after.step) == 1

    def loss_of(params):
        inputs = roll_azimuths(jax.random.fold_in(jax.random.key(5), 0), jnp.asarray(batch.inputs))
        hidden = inputs @ params["Dense_0"]["kernel"] + params["Dense_0"]["bias"][None]
        hidden = (hidden - hidden.mean(0)[None]) / jnp.sqrt(hidden.var(0) + 1e-5)[None]
        hidden = hidden * params["BatchNorm_0"]["scale"][None] + params["BatchNorm_0"]["bias"][None]
        found = nn.relu(hidden) @ params["Dense_1"]["kernel"] + params["Dense_1"]["bias"][None]
        found = found.reshape(4, 3, 8)
        apart = jnp.sqrt(jnp.square(found[:, :1] - found[:, 1:]).sum(-1))
        return nn.relu(0.5 + apart[:, :1] - apart[:, 1:]).sum(1).mean()

    expected, gradient = jax.jit(jax.value_and_grad(loss_of))(before.params)
    assert float(metrics["loss"]) == pytest.approx(float(expected), rel=1e-4)
    decayed = jax.tree.map(lambda slope, value: slope + 1e-3 * value, gradient, before.params)
    for slope, old, new in zip(*map(jax.tree.leaves, (decayed, before.params, after.params)), strict=True):
        clear = np.abs(slope) > 1e-4
        np.testing.assert_allclose((new - old)[clear], -0.01 * np.sign(slope)[clear], rtol=2e-2)
    assert "batch_stats" in after.statistics


def test_the_loss_falls_and_places_are_found(data, held_out, tmp_path):
    score = HeldOutScore(TINY, held_out)
    found = train_learned(TINY, data, settings(images=9000), tmp_path / "run", score=score)
    assert found.images == 9000 and int(found.state.step) == 225 and found.seconds > 0
    losses = [line["loss"] for line in read_metrics(tmp_path / "run/metrics.jsonl")]
    assert np.mean(losses[-5:]) < 0.2 * np.mean(losses[:2])
    names = {path.name for path in (tmp_path / "run").glob("weights*")}
    assert names == {"weights", "weights-1000", "weights-2000", "weights-4000", "weights-8000"}
    scores = read_metrics(tmp_path / "run/scores.jsonl")
    assert [line["images"] for line in scores] == [1000, 2000, 4000, 8000, 9000]
    assert scores[-1]["recall_at_1"] == score(variables_of(found.state))["recall_at_1"] > 0.5
    assert_equal(load_variables(tmp_path / "run", TINY), variables_of(found.state))
    about = json.loads((tmp_path / "run/weights-4000/config.json").read_text())
    assert about["method"] == "tiny" and about["images"] == 4000 and about["settings"]["learning_rate"] == 1e-2


@pytest.mark.parametrize("sampling", [TINY.recipe.sampling, MINED], ids=["random", "mined"])
def test_a_resumed_run_equals_an_uninterrupted_one(data, tmp_path, sampling):
    method = dataclasses.replace(TINY, recipe=dataclasses.replace(TINY.recipe, sampling=sampling))
    whole = train_learned(method, data, settings(), tmp_path / "whole")
    done = 0

    def after_few_steps():
        nonlocal done
        done += 1
        return done % 15 == 0

    part = train_learned(method, data, settings(), tmp_path / "parts", stopped=after_few_steps)
    assert int(part.state.step) == 15
    while part.images < 1200:
        part = train_learned(method, data, settings(), tmp_path / "parts", resume=True, stopped=after_few_steps)
    assert_equal(part.state, whole.state)
    lines = [read_metrics(tmp_path / name / "metrics.jsonl") for name in ("whole", "parts")]
    assert [(a["step"], a["loss"]) for a in lines[0]] == [(b["step"], b["loss"]) for b in lines[1]]
    snapshots = [load_variables(tmp_path / name / "weights-1000", method) for name in ("whole", "parts")]
    assert_equal(*snapshots)


def test_a_run_is_neither_overwritten_nor_resumed_with_other_settings(data, tmp_path):
    train_learned(TINY, data, settings(images=40), tmp_path)
    with pytest.raises(FileExistsError, match="there is a run already"):
        train_learned(TINY, data, settings(images=40), tmp_path)
    with pytest.raises(ValueError, match=r"found others: settings\.seed"):
        train_learned(TINY, data, settings(seed=1), tmp_path, resume=True)
    with pytest.raises(FileNotFoundError, match="expected a run to resume"):
        train_learned(TINY, data, settings(), tmp_path / "none", resume=True)
    assert train_learned(TINY, data, settings(images=80), tmp_path, resume=True).images == 80


def test_a_loss_that_is_not_finite_names_the_step(data, tmp_path):
    def breaks(variables, tuples):
        return jnp.where(tuples.descriptors.mean() > -jnp.inf, jnp.nan, 0.0)

    with pytest.raises(FloatingPointError, match="step 1: loss not finite"):
        train_learned(dataclasses.replace(TINY, loss=breaks), data, settings(), tmp_path)


def test_the_best_of_three_rates_is_found_and_recorded(data, held_out, tmp_path):
    score = HeldOutScore(TINY, held_out)
    options = {"seconds": 0.5}
    best = best_rate(TINY, data, score, tmp_path, **options)
    found = json.loads((tmp_path / "rates.json").read_text())
    assert found["best"] == best and set(found["recall_at_1"]) == {"1e-06", "0.01", "0.02"}
    assert found["recall_at_1"][f"{best:g}"] == max(found["recall_at_1"].values())
    assert best_rate(TINY, data, score, tmp_path, **options) == best  # nothing is trained again
    assert json.loads((tmp_path / "rates.json").read_text()) == found
    path = tmp_path / "rate-0.01/score.json"
    scores = json.loads(path.read_text())
    write_json(path, scores | {"scored": scores["scored"] | {"step": 0}})
    best_rate(TINY, data, score, tmp_path, **options)  # scored again after other steps
    assert json.loads(path.read_text()) == scores
    other = HeldOutScore(TINY, prepare_inputs(TINY, [loop("d", 3)], tmp_path / "cache"))
    best_rate(TINY, data, other, tmp_path, **options)  # and on other recordings
    assert "recall_at_1 d" in json.loads(path.read_text())


def test_damaged_and_foreign_weights_are_errors(tmp_path):
    variables = random_variables(TINY, seed=0)
    save_variables(tmp_path / "w", TINY, variables, {"images": 3})
    assert_equal(load_variables(tmp_path / "w", TINY), variables)
    other = dataclasses.replace(TINY, name="other")
    with pytest.raises(ValueError, match="expected weights of the method 'other', found those of 'tiny'"):
        load_variables(tmp_path / "w", other)
    with pytest.raises(ValueError, match="batch_stats/BatchNorm_0/mean as no array"):
        load_variables(tmp_path / "w", dataclasses.replace(TINY, network=Rings(normalised=False)))
    params = dict(variables["params"])
    del params["Dense_1"]
    save_variables(tmp_path / "less", TINY, {**variables, "params": params}, {})
    with pytest.raises(ValueError, match=r"params/Dense_1/bias as float32 .*, found no array"):
        load_variables(tmp_path / "less", TINY)
    with pytest.raises(FileNotFoundError, match=r"config\.json is missing"):
        load_variables(tmp_path / "nothing", TINY)


def test_random_weights_have_a_seed():
    assert_equal(load_variables("random:3", TINY), random_variables(TINY, seed=3))
    with pytest.raises(ValueError, match="expected a seed"):
        load_variables("random:x", TINY)


def test_a_training_starts_from_the_weights_of_its_method(data, tmp_path):
    def start(variables, inputs):
        assert inputs.shape == (100, SECTORS)
        kernel = np.zeros_like(variables["params"]["Dense_1"]["kernel"])
        return {**variables, "params": {**variables["params"], "Dense_1": {"kernel": kernel, "bias": kernel[0]}}}

    still = dataclasses.replace(TINY, start=start)
    found = train_learned(still, data, settings(images=40, learning_rate=1e-9), tmp_path / "run")
    assert abs(variables_of(found.state)["params"]["Dense_1"]["kernel"]).max() < 1e-6
