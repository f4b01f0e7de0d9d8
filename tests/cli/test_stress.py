"""bin/stress on a simulated recording with a sensor of 64 rings, of few points each."""

import json
import os
import shutil

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.corruption import CORRUPTIONS
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.sensor import Sensor

from .conftest import assert_one_line_error

load = sglpr_jax.DescriptorFile.load


@pytest.fixture(scope="session")
def rings(tmp_path_factory):
    """Recording 00 of 100 scans with 64 rings of 30 points."""
    root = tmp_path_factory.mktemp("data") / "rings"
    return simulate(root, routes=("00",), scans=100, sensor=Sensor(azimuth_steps=30)).root


@pytest.fixture
def stress(command, tmp_path):
    """Run bin/stress; return how it ended and the folder that it should have written."""

    def call(*arguments, out="out"):
        return command("stress", "--out", tmp_path / out, *arguments), tmp_path / out

    return call


@pytest.mark.slow
def test_everything_on_the_network_and_a_baseline(stress, rings, trained):
    options = ("--data", rings, "--weights", trained.folder, "--method", "solid")
    ended, out = stress(*options, "--protocol", "pairs-all-f1max", "ssc-recall")
    assert ended.status == 0, ended.error
    names = {"results.json", "config.json", "command.json", "stress.png", "descriptors"}
    assert {path.name for path in out.iterdir()} == names
    names = ["clean", *(corruption.name for corruption in CORRUPTIONS)]
    files = {f"{name}-{method}.npz" for name in names for method in ("sglpr", "solid")}
    assert {path.name for path in (out / "descriptors").iterdir()} == files
    rows = json.loads((out / "results.json").read_text())
    assert [row["corruption"] for row in rows] == names
    clean = rows[0]["methods"]["solid"]
    for row in rows:
        assert list(row["methods"]) == ["sglpr", "solid"]
        for was, found in zip(clean, row["methods"]["solid"], strict=True):
            assert found["counts"] == was["counts"] and found["change"] == found["score"] - was["score"]
            assert f"{found['score']:.3f}" in ended.out
    assert all(name in ended.out for name in names)
    config = json.loads((out / "config.json").read_text())
    assert config["protocols"] == ["pairs-all-f1max", "ssc-recall"] and config["seed"] == 0
    assert config["methods"]["sglpr"]["weights"] == load(out / "descriptors" / "clean-sglpr.npz").weights_hash


@pytest.mark.slow
def test_descriptors_are_those_of_embed_and_change_when_disturbed(stress, rings, command, tmp_path):
    ended, out = stress("--data", rings, "--method", "solid", "--corruption", "rotation", "dropout-0.9", "--seed", 3)
    assert ended.status == 0, ended.error
    options = ("--data", rings, "--method", "solid", "--out", tmp_path / "one.npz")
    for name, more in (("clean", ()), ("rotation", ("--rotate", "--seed", 3))):
        assert command("embed", *options, *more).status == 0
        np.testing.assert_array_equal(
            load(tmp_path / "one.npz").descriptors, load(out / "descriptors" / f"{name}-solid.npz").descriptors
        )
    clean, dropped = (load(out / "descriptors" / f"{name}-solid.npz") for name in ("clean", "dropout-0.9"))
    assert (clean.descriptors != dropped.descriptors).any(axis=1).all()
    np.testing.assert_array_equal(clean.positions, dropped.positions)


@pytest.mark.slow
def test_a_second_run_takes_the_descriptors_that_are_there(stress, rings):
    options = ("--data", rings, "--method", "solid", "--corruption", "beams")
    first, out = stress(*options)
    file = out / "descriptors" / "beams-16-solid.npz"
    clean = out / "descriptors" / "clean-solid.npz"
    written = clean.stat().st_mtime_ns
    before = load(file)
    file.unlink()
    again, _ = stress(*options)
    assert again == first and again.status == 0
    assert clean.stat().st_mtime_ns == written
    np.testing.assert_array_equal(load(file).descriptors, before.descriptors)
    assert stress(*options, "--protocol", "ssc-recall")[0].status == 0, "other protocols need no new descriptors"
    assert clean.stat().st_mtime_ns == written


@pytest.mark.slow
def test_descriptors_of_other_settings_are_never_taken(stress, rings, trained, random_params, tmp_path):
    options = ("--method", "solid", "--corruption", "dropout-0.5")
    _, out = stress(*options, "--data", rings)
    ended, _ = stress(*options, "--data", rings, "--seed", 1)
    assert_one_line_error(ended, out / "descriptors" / "dropout-0.5-solid.npz", "seed 1, found 0", "--out")
    assert json.loads((out / "config.json").read_text())["seed"] == 0, "as the results beside it"

    thinner = tmp_path / "thinner"
    shutil.copytree(rings, thinner)
    scan = thinner / "sequences" / "00" / "velodyne" / "000003.bin"
    os.truncate(scan, scan.stat().st_size - 16)
    os.truncate(label := thinner / "sequences" / "00" / "labels" / "000003.label", label.stat().st_size - 4)
    assert_one_line_error(
        stress(*options, "--data", thinner)[0], "clean-solid.npz", "expected descriptors made with scans"
    )

    weights = tmp_path / "weights"
    shutil.copytree(trained.folder / "weights", weights)
    assert stress("--weights", weights, "--data", rings, "--corruption", "rotation")[0].status == 0
    sglpr_jax.save(random_params(sglpr_jax.load(weights).config), weights)
    ended, _ = stress("--weights", weights, "--data", rings, "--corruption", "rotation")
    assert_one_line_error(ended, "clean-sglpr.npz", "made with weights")


def test_ready_made_images_can_only_be_turned(stress, images):
    options = ("--data", images, "--seq", "06", "--method", "polar-fft")
    ended, out = stress(*options, "--corruption", "beams-16")
    assert_one_line_error(ended, "beams-16 needs points, found only images in sequence 06", "rotation")
    assert not out.exists()


def test_a_drive_that_never_comes_back_has_nothing_to_lose(stress, images):
    ended, out = stress("--data", images, "--seq", "06", "--method", "polar-fft")
    assert "only images, which can only be rotated" in ended.error
    assert_one_line_error(ended, "sequence 06", "visited twice", "top1-f1max, pairs-f1max")
    assert not (out / "results.json").exists()


def test_wrong_names_are_refused_before_any_work(stress, rings, tmp_path):
    options = ("--data", rings, "--method", "solid")
    assert_one_line_error(
        stress(*options, "--corruption", "beams-61")[0], "expected a corruption, found 'beams-61'", "mean 'beams-16'"
    )
    assert_one_line_error(
        stress(*options, "--protocol", "top1")[0], "expected a protocol, found 'top1'", "mean 'top1-f1max'"
    )
    assert_one_line_error(stress("--data", rings, "--weights", "sglprr")[0], "sglprr: expected a folder")
    assert not (tmp_path / "out").exists()


def test_scans_without_poses_or_rings_are_refused_before_any_work(stress, tmp_path):
    scans = tmp_path / "my_scans"
    scans.mkdir()
    for i in range(3):
        np.random.default_rng(i).normal(scale=9, size=(3000, 4)).astype("<f4").tofile(scans / f"{i}.bin")
    options = ("--data", scans, "--method", "solid", "--format", "kitti")
    assert_one_line_error(stress(*options)[0], "my_scans", "expected poses")
    np.savetxt(scans / "poses.txt", np.tile(np.eye(3, 4).ravel(), (3, 1)))
    only_beams = stress(*options, "--corruption", "beams")[0]
    assert_one_line_error(only_beams, "scan 0 of sequence my_scans: beams-32: expected a scan with rings")
    assert not (tmp_path / "out").exists()


def test_a_corruption_that_needs_rings_is_left_out_of_scans_without(stress, tmp_path):
    scans = tmp_path / "my_scans"
    scans.mkdir()
    places = np.concatenate([np.arange(60), np.arange(12)])
    for i, place in enumerate(places):
        np.random.default_rng(place).normal(scale=9, size=(300, 4)).astype("<f4").tofile(scans / f"{i}.bin")
    rows = "".join(f"1 0 0 {30 * place} 0 1 0 0 0 0 1 0\n" for place in places)
    (scans / "poses.txt").write_text(rows)
    (scans / "times.txt").write_text("".join(f"{1.5 * i}\n" for i in range(len(places))))
    options = ("--data", scans, "--method", "solid", "--format", "kitti", "--protocol", "top1-f1max")
    ended, out = stress(*options, "--corruption", "beams-16", "noise-0.05")
    assert ended.status == 0
    assert "skipped beams-16: scan 0 of sequence my_scans: beams-16: expected a scan with rings" in ended.error
    assert "noise-0.05" in ended.out and "beams-16" not in ended.out
    assert list(json.loads((out / "config.json").read_text())["left_out"]) == ["beams-16"]
