import shutil
from pathlib import Path

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.cli.embed import EmbedCommand
from sglpr_jax.cli.loops import LoopsCommand
from sglpr_jax.cli.map import MapCommand
from sglpr_jax.cli.recording import PosedRecordingOptions
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


def test_without_out_the_file_is_beside_the_recording(command, scans, town):
    ended = command("embed", "--method", "polar-fft", "--data", scans)
    assert ended.status == 0, ended.error
    assert len(load(scans.with_name("my_scans.npz"))) == 12
    assert EmbedCommand(town, source=PosedRecordingOptions(seq="08")).target == f"{town}-08.npz"
    assert LoopsCommand((Path("/a/drive.mcap"), Path("/b/c"))).folder == Path("/a/drive-loops")
    assert MapCommand(Path("/a/drive.mcap"), "auto").file == Path("/a/drive.safetensors")


def test_a_store_gets_each_recording_once(command, scans, tmp_path):
    arguments = ("--method", "polar-fft", "--data", scans, "--site", "north", "--out", f"{tmp_path}/places/")
    first, again = command("embed", *arguments), command("embed", *arguments)
    assert first.status == again.status == 0, (first.error, again.error)
    (address,) = stored_places(f"{tmp_path}/places/")
    rows = read_places(address)
    assert len(rows) == 12 and set(rows["site"].to_pylist()) == {"north"}
    name = Path(address).name
    assert f"{name}: 12 places" in first.out and f"{name}: already there" in again.out


def test_embedding_repeats_the_descriptors_of_the_final_test(embed, trained, town):
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


def test_a_bad_scan_is_an_error_and_skipped_only_with_skip_bad(embed, scans, tmp_path):
    whole = load(embed("--method", "polar-fft", "--data", scans)[1])
    bad = scans / "000004.bin"
    bad.write_bytes(bad.read_bytes()[:100])
    options = ("--method", "polar-fft", "--data", scans)
    ended, out = embed(*options, out="strict.npz")
    assert_one_line_error(ended, bad, "16 bytes for each point", "100 bytes")
    assert not out.exists() and not list(tmp_path.glob(".*.tmp"))

    ended, out = embed(*options, "--skip-bad", out="lenient.npz")
    assert ended.status == 0
    assert f"skipped 000004: {bad}" in ended.error and "11 descriptors of 320 numbers, 1 scans skipped" in ended.out
    file = load(out)
    assert file.ids == tuple(f"{i:06d}" for i in range(12) if i != 4)
    np.testing.assert_array_equal(file.descriptors, np.delete(whole.descriptors, 4, axis=0))


@pytest.mark.slow
def test_corrupted_scans_have_other_descriptors_and_the_same_poses(embed, command, town, tmp_path):
    options = ("--data", town, "--seq", "08", "--method", "solid", "--seed", 3)
    files = {}
    for name, more in {
        "clean": (),
        "rotate": ("--rotate",),
        "rotation": ("--corruption", "rotation"),
        "dropped": ("--corruption", "dropout-0.9"),
    }.items():
        ended, path = embed(*options, *more, out=f"{name}.npz")
        assert ended.status == 0, ended.error
        files[name] = load(path)
    np.testing.assert_array_equal(files["rotation"].descriptors, files["rotate"].descriptors)
    assert (files["clean"].descriptors != files["dropped"].descriptors).any(axis=1).all()
    np.testing.assert_array_equal(files["clean"].positions, files["dropped"].positions)
    assert_one_line_error(embed(*options, "--corruption", "beams")[0], "expected a corruption", "mean 'beams-32'")
    in_store = command("embed", *options, "--corruption", "beams-4", "--out", f"{tmp_path}/places/")
    assert_one_line_error(in_store, "expected a descriptor file with --corruption")
