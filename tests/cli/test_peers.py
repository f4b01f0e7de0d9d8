"""bin/peers trains networks of other publications, and bin/embed describes recordings with them."""

import json
import shutil

import numpy as np
import pytest

from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.training import peers
from sglpr_jax.training.metrics_log import read_metrics

from .conftest import assert_one_line_error, run_command


@pytest.fixture(scope="module")
def run(town, tmp_path_factory):
    """A run of RINet of two steps on `data`, beside it, with the held-out dataset `held-out`."""
    folder = tmp_path_factory.mktemp("runs")
    data, held_out, out = (folder / name for name in ("data", "held-out", "rinet"))
    for root, name in ((data, "00"), (data, "05"), (held_out, "08")):
        shutil.copytree(town / "sequences" / name, root / "sequences" / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(peers, "best_rate", lambda *_, **__: 0.002)  # tests/training searches
        options = ("--out", out, "--images", 2000, "--held-out", held_out)
        ended = run_command("peers", "train", "rinet", data, *options)
    assert ended.status == 0, ended.error
    return out


def embed(out, *arguments):
    return run_command("embed", "--out", out, *arguments)


def test_a_run_writes_its_settings_its_measurements_and_snapshots(run):
    assert {path.name for path in run.iterdir()} >= {"weights", "weights-1000", "weights-2000"}
    config = json.loads((run / "config.json").read_text())
    assert config["method"] == "rinet" and [one["name"] for one in config["recordings"]] == ["00", "05"]
    assert config["settings"] == {"learning_rate": 0.002, "seed": 0, "seconds": 3600.0, "images": 2000}
    assert json.loads((run / "command.json").read_text())["learning-rate"] == 0.002
    lines = read_metrics(run / "metrics.jsonl")
    assert [line["images"] for line in lines] == [1536, 3072]
    assert lines[0]["seconds"] < lines[-1]["seconds"] and all(np.isfinite(line["loss"]) for line in lines)
    scores = read_metrics(run / "scores.jsonl")
    assert [line["images"] for line in scores] == [1536, 3072]
    assert all(0 <= line["recall_at_1 08"] == line["recall_at_1"] <= 1 for line in scores)
    about = json.loads((run / "weights-1000" / "config.json").read_text())
    assert about["method"] == "rinet" and about["images"] == 1536


def test_a_finished_run_resumes_without_steps_and_is_not_overwritten(run):
    before = read_metrics(run / "metrics.jsonl")
    again = ("peers", "train", "rinet", run.with_name("data"), "--out", run, "--images", 2000, "--learning-rate", 0.002)
    assert_one_line_error(run_command(*again), run, "there is a run already")
    assert run_command(*again, "--resume").status == 0
    assert read_metrics(run / "metrics.jsonl") == before
    assert_one_line_error(run_command(*again, "--resume", "--seed", 1), "settings.seed")
    assert json.loads((run / "command.json").read_text())["seed"] == 0


def test_a_held_out_recording_inside_the_training_data_is_an_error(town, tmp_path):
    ended = run_command("peers", "train", "rinet", town, "--out", tmp_path / "run", "--held-out", town)
    assert_one_line_error(ended, "expected recordings not in DATA, found")


def test_trained_weights_describe_a_recording_and_compare_it(run, town, tmp_path):
    options = ("--method", "rinet", "--data", town, "--seq", "08")
    ended = embed(tmp_path / "08.npz", "--weights", run / "weights-1000", *options)
    assert ended.status == 0 and "40 descriptors of 288 numbers" in ended.out, ended.error
    file = DescriptorFile.load(tmp_path / "08.npz")
    assert file.config["method"] == "rinet" and file.weights_hash
    apart = distance_function(file.distance)(file.descriptors, file.descriptors)
    assert apart.shape == (40, 40) and (apart >= 0).all() and (apart <= 1).all() and np.ptp(apart) > 0
    ended = run_command("evaluate", tmp_path / "08.npz", "--out", tmp_path / "found")
    assert ended.status == 0, ended.error
    for name, weights in (("last", run), ("random", "random:0")):
        assert embed(tmp_path / f"{name}.npz", "--weights", weights, *options).status == 0
        other = DescriptorFile.load(tmp_path / f"{name}.npz")
        assert (other.descriptors != file.descriptors).any() and other.distance != file.distance


def test_weights_of_another_method_are_an_error(trained, town, tmp_path):
    options = ("--method", "rinet", "--data", town, "--seq", "08")
    ended = embed(tmp_path / "08.npz", *options)
    assert_one_line_error(ended, "rinet: expected --weights with a folder of")
    ended = embed(tmp_path / "08.npz", *options, "--weights", trained.folder)
    assert_one_line_error(ended, "expected weights of the method 'rinet', found those of 'sglpr'")


def test_the_list_has_every_method(command):
    ended = command("peers", "list")
    assert ended.status == 0 and "98,765" in ended.out
    assert not [name for name in LEARNED if name not in ended.out]
