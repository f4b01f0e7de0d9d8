"""bin/train is one call of the library."""

import dataclasses
import json

import numpy as np
import pytest

from sglpr_jax.data.readers import open_recording
from sglpr_jax.files import DataWarning
from sglpr_jax.models.weights import for_places, weights_hash, with_whitening
from sglpr_jax.models.weights_file import load, save
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.recipe import train, with_kept_descriptors
from sglpr_jax.training.trainer import METRICS_FILE


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:expected labels for the segmentation head")
def test_a_training_is_one_call(images, preset, tmp_path):
    config = dataclasses.replace(load_preset(str(preset)), steps=3)
    recordings, told = [open_recording(images, "00")], []

    class Noting(Callback):
        def on_score(self, step, scores):
            told.append(step)

        def on_end(self, step):
            told.append(f"end {step}")

        def close(self):
            told.append("closed")

    out = tmp_path / "run"
    stops = iter([False, True])
    with pytest.warns(DataWarning, match="found none in 1 recording.*the head keeps its initial weights"):
        stopped = train(config, recordings, out=out, callback=Noting(), stopped=lambda: next(stops))
    assert (stopped.steps, stopped.finished) == (2, False) and told == [2, "end 2", "closed"]
    with pytest.raises(FileExistsError, match="there is a run already"):
        train(config, recordings, out=out)
    with pytest.raises(ValueError, match="others: recordings"):
        train(config, [open_recording(images, "06")], out=out, resume=True)
    result = train(config, recordings, out=out, resume=True)
    assert result.finished and result.folder == out and f"{out}: 3 of 3 steps" in str(result)
    assert weights_hash(load(out)) == weights_hash(result.params)
    settings = json.loads((out / "config.json").read_text())
    assert settings["recordings"] == ["00"] and settings["test"] is None
    whole = train(config, recordings, out=tmp_path / "whole", cache=tmp_path / "packs")
    assert weights_hash(whole.params) == weights_hash(result.params)


@pytest.mark.slow
def test_a_network_learns_the_descriptors_of_a_teacher_and_says_so(images, preset, random_params, tmp_path):
    config = load_preset(str(preset))
    teacher = for_places(random_params(config.model))
    save(teacher, tmp_path / "teacher")
    loss = dataclasses.replace(config.loss, teacher=str(tmp_path / "teacher"), ce_weight=0.0, dice_weight=0.0)
    config = dataclasses.replace(config, loss=loss, steps=1, score_every=1)
    params = train(config, [open_recording(images, "00")], out=tmp_path / "run").params
    assert params.config.descriptors_of == weights_hash(load(tmp_path / "run")) == weights_hash(teacher)
    (step, *_) = read_metrics(tmp_path / "run" / METRICS_FILE)
    assert step["teacher"] < 1e-6  # the same layers began with the weights of the teacher


def test_recordings_that_cannot_be_trained_on_are_refused_before_the_run(
    images, labelled_images, random_params, preset, tmp_path
):
    config, recording = load_preset(str(preset)), open_recording(images, "00")
    with pytest.raises(ValueError, match="other than the one tested, found 00 in both"):
        train(config, [recording], out=tmp_path / "run", test=recording)
    with pytest.raises(ValueError, match="sequence 00 has no poses"):
        train(config, [dataclasses.replace(recording, positions=None)], out=tmp_path / "run")
    shared = {"sampling": dataclasses.replace(config.sampling, negatives=0), "chunk": 0, "tuples": 4}
    with pytest.raises(ValueError, match="the triplet loss has no negatives"):
        dataclasses.replace(config, **shared)
    room = dataclasses.replace(recording, positions=np.asarray(recording.positions) * 0.01)
    with pytest.raises(ValueError, match="expected places farther apart than"):
        train(dataclasses.replace(config, **shared, share_negatives=True), [room], out=tmp_path / "run")
    taught = dataclasses.replace(config, loss=dataclasses.replace(config.loss, teacher="sglpr"))
    with pytest.raises(ValueError, match=r"loss\.teacher sglpr: expected the grid of .*, found Grid"):
        train(taught, [recording], out=tmp_path / "run")
    head = dataclasses.replace(config.model.head, input="labels")
    reads = dataclasses.replace(config, model=dataclasses.replace(config.model, head=head))
    with pytest.raises(ValueError, match="expected labels beside every scan of sequence 00, found 0 of 30"):
        train(reads, [recording], out=tmp_path / "run")
    alone = dataclasses.replace(config, loss=dataclasses.replace(config.loss, segmentation_alone=True))
    with pytest.raises(ValueError, match="expected labels beside some scans, found none in 1 recording"):
        train(alone, [recording], out=tmp_path / "run")
    labelled = open_recording(labelled_images, "00")
    with pytest.raises(ValueError, match="expected weights to begin with, found none"):
        train(alone, [labelled], out=tmp_path / "run")
    given = with_whitening(
        random_params(config.model), np.random.default_rng(0).normal(size=(600, 256)).astype(np.float32)
    )
    with pytest.raises(ValueError, match=r"expected model\.head\.whiten True, as in the weights, found False"):
        train(alone, [labelled], out=tmp_path / "run", weights=given)
    given = random_params(dataclasses.replace(config.model, blind_m=2.0, categories=0))
    with pytest.raises(ValueError, match=r"expected model\.blind_m 2\.0, as in the weights, found 0\.0"):
        train(alone, [labelled], out=tmp_path / "run", weights=given)
    given = random_params(dataclasses.replace(config.model, descriptors_of="a teacher"))
    assert with_kept_descriptors(alone, given).model == given.config
    mixed = dataclasses.replace(config, also_tuples=1)
    with pytest.raises(ValueError, match="no effect: expected labels in --also and a segmentation head, or --also-"):
        train(mixed, [labelled], out=tmp_path / "run", also=[recording])
    mixed = dataclasses.replace(mixed, also_triplets=True, share_negatives=True)
    first, second = (dataclasses.replace(labelled, name=name, world="town") for name in ("first", "second"))
    with pytest.raises(ValueError, match="found one of first in --data and second in --also"):
        train(mixed, [first], out=tmp_path / "run", also=[second])
    assert not list(tmp_path.iterdir())
