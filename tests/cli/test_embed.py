import dataclasses
import errno
import json
import shutil
import warnings
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import safetensors.numpy

import sglpr_jax
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.names import AnyMethodName
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.retrieval.parquet import read_places, stored_places

from .conftest import assert_one_line_error

load = sglpr_jax.DescriptorFile.load


@pytest.fixture
def embed(command, tmp_path):
    """Run bin/embed; return how it ended and the file that it should have written."""

    def call(*arguments, out="out.npz"):
        return command("embed", "--out", tmp_path / out, *arguments), tmp_path / out

    return call


@pytest.fixture
def scans(town, tmp_path):
    """A plain folder of twelve scans, without poses."""
    folder = tmp_path / "my_scans"
    shutil.copytree(town / "sequences" / "08" / "velodyne", folder)
    for path in sorted(folder.iterdir())[12:]:
        path.unlink()
    return folder


def test_a_store_gets_each_recording_once(command, scans, tmp_path):
    arguments = ("--method", "thumbnail", "--data", scans, "--site", "north", "--out", f"{tmp_path}/places/")
    first, again = command("embed", *arguments), command("embed", *arguments)
    assert first.status == again.status == 0, (first.error, again.error)
    (address,) = stored_places(f"{tmp_path}/places/")
    rows = read_places(address)
    assert len(rows) == 12 and set(rows["site"].to_pylist()) == {"north"}
    name = Path(address).name
    assert f"{name}: 12 places" in first.out and f"{name}: already there" in again.out


def test_embedding_is_what_the_training_tested_and_twice_the_same(embed, trained, town):
    ended, first = embed("--weights", trained.folder, "--data", town, "--seq", "08")
    assert ended.status == 0, ended.error
    assert ended.out.strip() == f"{first}: 40 descriptors of 256 numbers, 0 scans skipped"
    _, second = embed("--weights", trained.folder / "weights", "--data", town, "--seq", "08", out="again.npz")
    assert first.read_bytes() == second.read_bytes() or np.array_equal(
        load(first).descriptors, load(second).descriptors
    )
    file, tested = load(first), load(trained.folder / "test" / "sglpr-raw.npz")
    np.testing.assert_array_equal(file.descriptors, tested.descriptors)
    np.testing.assert_allclose(np.linalg.norm(file.descriptors, axis=1), 1, rtol=1e-5)
    assert file.sequence == "08" and file.ids[:2] == ("000000", "000001")
    assert file.times is not None and file.pose_source == "sequences/08/poses.txt"
    assert file.weights_hash == tested.weights_hash
    assert file.config["model"]["grid"]["resolution_m"] == 3.2


def test_a_descriptor_does_not_depend_on_the_batch(embed, trained, town):
    options = ("--weights", trained.folder, "--data", town, "--seq", "08")
    alone = load(embed(*options, "--batch", 1)[1])
    together = load(trained.folder / "test" / "sglpr-raw.npz")
    np.testing.assert_allclose(alone.descriptors, together.descriptors, atol=1e-5)


def test_rotations_follow_their_seed(embed, town):
    options = ("--method", "thumbnail", "--data", town, "--seq", "08", "--rotate", "--seed")
    first, again, other = (load(embed(*options, seed, out=f"{i}.npz")[1]) for i, seed in enumerate((3, 3, 4)))
    np.testing.assert_array_equal(first.descriptors, again.descriptors)
    assert np.abs(first.descriptors - other.descriptors).max() > 0.1
    assert first.config["rotation_seed"] == 3 and first.weights_hash == ""


def test_a_folder_of_scans_needs_no_poses(embed, scans, trained):
    ended, out = embed("--weights", trained.folder, "--data", scans)
    assert ended.status == 0, ended.error
    file = load(out)
    assert len(file) == 12 and file.positions is None and file.sequence == "my_scans"


@pytest.mark.parametrize(("size", "found"), [(100, "100 bytes"), (0, "0 bytes")])
def test_a_bad_scan_is_named_and_left_out_only_when_asked(embed, scans, tmp_path, size, found):
    whole = load(embed("--method", "thumbnail", "--data", scans)[1])
    bad = scans / "000004.bin"
    bad.write_bytes(bad.read_bytes()[:size])
    options = ("--method", "thumbnail", "--data", scans)
    ended, out = embed(*options, out="strict.npz")
    assert_one_line_error(ended, bad, "16 bytes for each point", found)
    assert not out.exists() and not list(tmp_path.glob(".*.tmp"))

    ended, out = embed(*options, "--skip-bad", out="lenient.npz")
    assert ended.status == 0
    assert f"skipped 000004: {bad}" in ended.error and "11 descriptors of 625 numbers, 1 scans skipped" in ended.out
    file = load(out)
    assert file.ids == tuple(f"{i:06d}" for i in range(12) if i != 4)
    np.testing.assert_array_equal(file.descriptors, np.delete(whole.descriptors, 4, axis=0))


def test_an_error_leaves_an_older_file_as_it_was(embed, scans):
    _, out = embed("--method", "thumbnail", "--data", scans)
    before = out.read_bytes()
    (scans / "000011.bin").write_bytes(b"cut")
    assert_one_line_error(embed("--method", "thumbnail", "--data", scans)[0], "000011.bin")
    assert out.read_bytes() == before


def test_only_bad_scans_make_no_file(embed, scans):
    for path in scans.iterdir():
        path.write_bytes(b"cut")
    ended, out = embed("--method", "thumbnail", "--data", scans, "--skip-bad")
    assert_one_line_error(ended, "my_scans", "at least one readable scan")
    assert ended.error.count("skipped") == 12 and not out.exists()


def test_poses_that_are_missing_or_not_numbers_are_named(embed, town, tmp_path):
    root = tmp_path / "town"
    shutil.copytree(town, root)
    poses = root / "sequences" / "08" / "poses.txt"
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join([*lines[:2], "nan " + lines[2].split(maxsplit=1)[1], *lines[3:]]))
    options = ("--method", "thumbnail", "--data", root, "--seq", "08")
    assert_one_line_error(embed(*options)[0], f"{poses}, line 3", "finite numbers", "nan")
    poses.write_text("\n".join(lines[:30]))
    assert_one_line_error(embed(*options)[0], poses, "at least 40 rows", "found 30")
    poses.unlink()  # KITTI's test sequences have none, unless they are asked for
    assert_one_line_error(
        embed(*options, "--pose-source", "semantickitti")[0], root, "sequences/08/poses.txt", "found none"
    )
    ended, out = embed(*options)
    assert ended.status == 0 and load(out).positions is None


def test_a_sequence_or_dataset_that_does_not_exist_is_named(embed, town, tmp_path):
    options = ("--method", "thumbnail", "--data")
    assert_one_line_error(embed(*options, town, "--seq", "8")[0], town, "'8'", "00, 05, 08")
    assert_one_line_error(embed(*options, town)[0], town, "the name of one sequence", "00, 05, 08")
    assert_one_line_error(embed(*options, tmp_path / "no")[0], tmp_path / "no", "no such folder")


def test_an_output_that_cannot_be_written_is_refused_before_the_work(embed, town):
    options = ("--method", "thumbnail", "--data", town, "--seq", "08")
    assert_one_line_error(embed(*options, out="no/out.npz")[0], "no/out.npz", "does not exist")
    assert_one_line_error(embed(*options, out="out")[0], ".npz")


def test_a_folder_that_cannot_be_written_is_told_before_the_recording_is_opened(embed, town, tmp_path, monkeypatch):
    def refuse(path, *arguments):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    options = ("--method", "thumbnail", "--data", town, "--seq", "08")
    (tmp_path / "folder.npz").mkdir()
    ended, _ = embed(*options, out="folder.npz")
    assert ended.error == f"error: {tmp_path / 'folder.npz'}: expected a file to write, found a folder\n"
    monkeypatch.setattr(Path, "touch", refuse)
    ended, out = embed(*options)
    assert ended.error == f"error: {out}: cannot be written: Permission denied\n"


def test_weights_that_do_not_exist_are_told_before_the_recording_is_opened(embed, town, tmp_path):
    ended, _ = embed("--data", town, "--seq", "08", "--weights", tmp_path / "nosuch")
    assert ended.error.startswith(f"error: {tmp_path / 'nosuch'}: expected a folder with config.json"), ended.error


@pytest.mark.parametrize("batch", [0, -1])
def test_a_batch_of_no_image_is_refused(embed, town, batch):
    ended, out = embed("--method", "thumbnail", "--data", town, "--seq", "08", "--batch", batch)
    assert_one_line_error(ended, "--batch: expected a number from 1", f"found {batch}")
    assert not out.exists()


def test_weights_beside_a_method_that_has_none_are_refused(embed, town):
    ended, _ = embed("--method", "solid", "--weights", "sglpr", "--data", town, "--seq", "08")
    assert_one_line_error(ended, "sglpr: expected --method sglpr or one of bin/peers with --weights, found solid")


@pytest.mark.slow
def test_without_weights_the_network_has_those_of_the_package(embed, town):
    options = ("--data", town, "--seq", "08")
    ended, found = embed(*options)
    assert ended.status == 0, ended.error
    _, named = embed(*options, "--weights", "sglpr", out="named.npz")
    np.testing.assert_array_equal(load(found).descriptors, load(named).descriptors)


def test_weights_that_are_not_there_are_named(embed, town, tmp_path):
    ended, _ = embed("--data", town, "--seq", "08", "--weights", tmp_path)
    assert_one_line_error(ended, tmp_path, "config.json", "model.safetensors", "missing")


def test_weights_of_another_model_or_damaged_ones_are_named(embed, town, trained, tmp_path):
    folder = tmp_path / "weights"
    shutil.copytree(trained.folder / "weights", folder)
    options = ("--data", town, "--seq", "08", "--weights", folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "backbone": {**config["backbone"], "embed_dim": 16}}))
    assert_one_line_error(
        embed(*options)[0], folder / "model.safetensors", "expected the weights of its configuration", "found"
    )
    (folder / "config.json").write_text(json.dumps({**config, "unknown": 1}))
    assert_one_line_error(embed(*options)[0], folder / "config.json", "ModelConfig", "unknown")
    (folder / "config.json").write_text(json.dumps(config)[:-20])
    assert_one_line_error(embed(*options)[0], folder / "config.json", "JSON")
    (folder / "config.json").write_text(json.dumps(config))
    content = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(content[: len(content) // 2])
    assert_one_line_error(embed(*options)[0], folder / "model.safetensors", "safetensors")
    one = dict(list(safetensors.numpy.load(content).items())[1:])
    safetensors.numpy.save_file(one, folder / "model.safetensors")
    assert_one_line_error(embed(*options)[0], folder / "model.safetensors", "missing")


def test_images_smaller_than_the_models_window_are_refused(embed, images, trained, tmp_path):
    params = sglpr_jax.load(trained.folder)
    grid = dataclasses.replace(params.config.grid, height=32, width=32)
    larger = sglpr_jax.Params(params.weights, dataclasses.replace(params.config, grid=grid))
    folder = sglpr_jax.save(larger, tmp_path / "weights")
    ended, _ = embed("--data", images, "--seq", "06", "--weights", folder)
    assert_one_line_error(ended, "32 x 32", "(22, 20)")


def test_every_baseline_can_be_chosen():
    assert get_args(AnyMethodName) == ("sglpr", *HANDCRAFTED, *LEARNED)


@pytest.mark.slow
@pytest.mark.parametrize("name", HANDCRAFTED)
def test_a_baseline_describes_a_sequence_and_names_its_distance(embed, town, name):
    ended, out = embed("--method", name, "--data", town, "--seq", "08")
    assert ended.status == 0, ended.error
    file = load(out)
    assert file.config["method"] == name and file.distance == HANDCRAFTED[name].distance_name and len(file) == 40
    distances = distance_function(file.distance)(file.descriptors[:2], file.descriptors)
    assert distances.shape == (2, 40)
    assert distances[0, 0] < 1e-3 < distances[0, 1:].min()


@pytest.mark.parametrize("name", [name for name, method in HANDCRAFTED.items() if method.takes != "images"])
def test_methods_on_points_refuse_images(embed, images, name):
    ended, out = embed("--method", name, "--data", images, "--seq", "06", "--skip-bad")
    assert_one_line_error(ended, f"{name} needs points", "only images in sequence 06", "polar-fft, thumbnail, random")
    assert not out.exists()


def test_semantic_scan_context_needs_labels(embed, scans):
    ended, _ = embed("--method", "ssc", "--data", scans, "--skip-bad")
    assert_one_line_error(ended, "ssc needs labels", "found none in sequence my_scans")


def test_turned_points_have_other_descriptors(embed, town):
    options = ("--method", "scan-context", "--data", town, "--seq", "08")
    raw, turned = (load(embed(*options, *more)[1]) for more in ((), ("--rotate", "--seed", 1)))
    assert (raw.descriptors != turned.descriptors).any(axis=1).all()


def test_what_was_found_is_said(embed, scans):
    ended, _ = embed("--method", "thumbnail", "--data", scans)
    said = ended.error.splitlines()
    assert said[0] == "my_scans: 12 scans" and said[-1] == "times: none; poses: none"
    assert said[1].startswith("format: kitti (16 bytes a point), found from 5 of 12 scans")
    assert said[2].startswith("sensor: ")


def test_other_records_give_the_same_descriptors(embed, scans, tmp_path):
    """float64x6 for float32x4: found out, or said; a wrong one is told."""
    whole = load(embed("--method", "thumbnail", "--data", scans)[1])
    for path in scans.iterdir():
        records = np.fromfile(path, "<f4").reshape(-1, 4).astype("<f8")
        np.column_stack([records, records[:, :2]]).tofile(path)
    for options in ((), ("--format", "float64x6")):
        ended, out = embed("--method", "thumbnail", "--data", scans, *options, out="other.npz")
        assert ended.status == 0, ended.error
        np.testing.assert_array_equal(load(out).descriptors, whole.descriptors)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        ended, _ = embed("--method", "thumbnail", "--data", scans, "--format", "float32x4")
    assert "warning: " in ended.error and "expected scans of float32x4 (16 bytes a point)" in ended.error


def test_scans_that_show_no_place_are_skipped_and_counted(embed, scans):
    records = np.fromfile(scans / "000003.bin", "<f4").reshape(-1, 4)
    for name, points in (("000003", np.full_like(records, np.nan)), ("000007", records * 5000)):
        points.tofile(scans / f"{name}.bin")
    options = ("--method", "scan-context", "--data", scans)
    assert_one_line_error(embed(*options)[0], "scan 000003", "expected finite points, found none")
    ended, out = embed(*options, "--skip-bad")
    assert ended.status == 0 and "10 descriptors" in ended.out and "2 scans skipped" in ended.out
    assert "skipped 000003" in ended.error and "skipped 000007" in ended.error and "millimetres" in ended.error
    assert "000003" not in load(out).ids


def test_the_height_of_the_sensor_can_be_said(embed, scans):
    ended, out = embed("--method", "scan-context", "--data", scans, "--sensor-height", "0.6")
    assert "sensor: 0.60 m above the ground, as given" in ended.error
    assert load(out).config["sensor"] == "0.60 m above the ground"
    ended, _ = embed("--method", "thumbnail", "--data", scans, "--sensor-height", "1730")
    assert_one_line_error(ended, "expected the sensor's height above the ground in metres, found 1730")


def test_consecutive_poses_far_apart_are_told(embed, scans):
    way = np.arange(12) * 2.0 + 500 * (np.arange(12) > 6)
    rows = np.tile(np.eye(3, 4), (12, 1, 1))
    rows[:, 0, 3] = way
    np.savetxt(scans / "poses.txt", rows.reshape(12, 12))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        ended, _ = embed("--method", "thumbnail", "--data", scans)
    assert (
        ended.status == 0 and "warning: " in ended.error and "are the poses in the order of the scans?" in ended.error
    )
