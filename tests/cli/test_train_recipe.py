"""Mining, validation, bfloat16 and a second dataset together, with the real command line."""

import json
import os
import signal

import numpy as np
import pytest
import safetensors.numpy

from sglpr_jax.evaluation import final_test
from sglpr_jax.training import batch_source
from sglpr_jax.training.metrics_log import read_metrics

from .conftest import run_command

RECIPE = (
    "--sampling.mining", "hardest", "--sampling.refresh-steps", 3, "--sampling.hardest", 4, "--steps", 6,
    "--validation.share", 0.2, "--model.compute", "bfloat16", "--sampling.negative-m", 17,
)  # fmt: skip
LABELLED = ("--tuples", 3, "--also-tuples", 1, "--loss.segment-every", 2)


@pytest.fixture(autouse=True)
def _no_final_test(monkeypatch):
    monkeypatch.setattr(final_test, "final_test", lambda *_, **__: None)


def weights_of(folder) -> dict[str, np.ndarray]:
    return safetensors.numpy.load_file(folder / "weights" / "model.safetensors")


@pytest.fixture(scope="module")
def mixed(town, images, preset, tmp_path_factory):
    """A run on two folders of images without labels, whose semantics come from simulated scans."""
    root = tmp_path_factory.mktemp("runs")
    out, monday, friday = (root / name for name in ("mixed", "monday", "friday"))
    for folder, name in ((monday, "00"), (friday, "06")):
        folder.mkdir()
        (folder / name).symlink_to(images / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(final_test, "final_test", lambda *_, **__: None)
        options = ("--seq", "06", "--data", monday, friday, "--also", town, "--preset", preset, "--out", out)
        ended = run_command("train", *options, *RECIPE, *LABELLED, "--tensorboard")
    assert ended.status == 0, ended.error
    return out, options, ended


@pytest.mark.slow
def test_a_run_on_two_datasets_learns_places_and_semantics(mixed, town):
    out, _, ended = mixed
    assert "training on 00; testing on 06" in ended.error and f"also training on 00, 05, 08 of {town}" in ended.error
    lines = read_metrics(out / "metrics.jsonl")
    steps = [line for line in lines if "loss" in line]
    assert len(steps) == 6 and all(line["cross_entropy"] > 0 and line["dice"] > 0 for line in steps)
    scores = [line for line in lines if "score" in line]
    assert all(line["score"] == line["recall_neighbours"] for line in scores)  # the images have no revisit
    assert sorted(path.name for path in (out / "mining").iterdir()) == ["0.npz", "3.npz"]
    settings = json.loads((out / "config.json").read_text())
    assert settings["also"] == [str(town)] and len(settings["data"]) == 2
    assert settings["config"]["also_tuples"] == 1
    assert json.loads((out / "weights" / "config.json").read_text())["compute"] == "bfloat16"
    (events,) = (out / "tensorboard").iterdir()
    assert b"gradient_norm" in events.read_bytes() and b"score" in events.read_bytes()


@pytest.mark.slow
def test_a_stopped_run_on_two_datasets_continues_to_the_same_weights(mixed, command, tmp_path, monkeypatch):
    whole, options, _ = mixed
    out = tmp_path / "run"
    options = (*options[:-1], out, *RECIPE, *LABELLED)
    mix, mixed_batches = batch_source.mix, []

    def interrupted(*arguments, **named):
        mixed_batches.append(1)
        if len(mixed_batches) == 4:  # the first batch after the refresh before step 3
            os.kill(os.getpid(), signal.SIGINT)
        return mix(*arguments, **named)

    monkeypatch.setattr(batch_source, "mix", interrupted)
    handler = signal.getsignal(signal.SIGINT)
    stopped = command("train", *options)
    assert stopped.status == 130 and "stopped at step 4 of 6; continue with --resume" in stopped.error
    assert signal.getsignal(signal.SIGINT) is handler
    refreshed = (out / "mining" / "3.npz").read_bytes()
    resumed = command("train", *options, "--resume")
    assert resumed.status == 0, resumed.error
    assert (out / "mining" / "3.npz").read_bytes() == refreshed
    found, expected = weights_of(out), weights_of(whole)
    assert found.keys() == expected.keys()
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name])
