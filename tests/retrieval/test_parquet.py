"""The store of places: one Parquet file for each recording, written once, in any file system."""

import dataclasses
import shutil
import sys
import uuid
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from scipy.spatial.transform import Rotation

import sglpr_jax
from sglpr_jax.methods.method import Method
from sglpr_jax.methods.registry import method_named
from sglpr_jax.retrieval.parquet import POSE, embed_to_store, place_rows, read_places, stored_places

from .places import file_of


@pytest.fixture(params=["file", "memory"])
def store(request, tmp_path) -> str:
    """Address of an empty store."""
    return f"{tmp_path}/places/" if request.param == "file" else f"memory://{uuid.uuid4().hex}/places"


@pytest.fixture
def scans(tmp_path) -> Path:
    """A plain folder of three scans."""
    rng, folder = np.random.default_rng(0), tmp_path / "drive"
    folder.mkdir()
    for number in range(3):
        points = rng.uniform(-20, 20, (500, 4)).astype(np.float32)
        points[:, 2] = -1.7
        points.tofile(folder / f"{number:06d}.bin")
    return folder


@pytest.fixture
def method() -> Method:
    """A method without weights."""
    return method_named("polar-fft")


def opened(folder: Path) -> sglpr_jax.Recording:
    return sglpr_jax.open_recording(folder, format="kitti", sensor_height=1.73)


def test_a_recording_is_described_once(store, scans, tmp_path, method):
    first, added = embed_to_store(store, method, opened(scans), site="north", source="here")
    assert added == 3
    shutil.copytree(scans, tmp_path / "copy" / "drive", copy_function=shutil.copyfile)  # with other times of change
    again, added = embed_to_store(store, method, opened(tmp_path / "copy" / "drive"))
    assert again == first and added is None
    (address,) = stored_places(store)
    rows = read_places(address)
    assert rows["scan"].to_pylist() == ["000000", "000001", "000002"] and set(rows["site"].to_pylist()) == {"north"}
    assert rows["x"].null_count == 3 and set(rows["source"].to_pylist()) == {"here"}
    file = sglpr_jax.embed(method, opened(scans))
    np.testing.assert_array_equal(np.stack(rows["descriptor"].to_numpy()), file.descriptors)


def test_other_scans_and_methods_are_other_files(store, scans, method):
    embed_to_store(store, method, opened(scans))
    embed_to_store(store, method, opened(scans), rotation_seed=1)
    with (scans / "000000.bin").open("r+b") as stream:
        stream.write(np.float32(3).tobytes())
    assert embed_to_store(store, method, opened(scans))[1] == 3
    assert len(stored_places(store)) == 3


def test_a_file_that_cannot_be_finished_does_not_appear(scans, tmp_path, monkeypatch, method):
    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ValueError, match=r"\.parquet: expected a store .* No space left on device"):
        embed_to_store(f"{tmp_path}/places/", method, opened(scans))
    assert not [path for path in (tmp_path / "places").rglob("*") if path.is_file()]


def test_files_that_are_no_places_are_refused(tmp_path):
    pyarrow.parquet.write_table(pyarrow.table({"x": [1]}), tmp_path / "x.parquet")
    with pytest.raises(ValueError, match=r"x\.parquet: expected format 'sglpr-jax places 1'"):
        read_places(str(tmp_path / "x.parquet"))
    (tmp_path / "y.parquet").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"y\.parquet: expected a store that can be read"):
        read_places(str(tmp_path / "y.parquet"))
    rows = place_rows(file_of(3), "first")
    pyarrow.parquet.write_table(rows.drop_columns(["site"]), tmp_path / "z.parquet")
    with pytest.raises(ValueError, match=r"z\.parquet: expected a column site of string, found none"):
        read_places(str(tmp_path / "z.parquet"))


def test_poses_have_rotations_where_these_are_known():
    file = dataclasses.replace(file_of(3), positions=np.arange(9.0).reshape(3, 3))
    turned = Rotation.random(3, rng=np.random.default_rng(0))
    rows = place_rows(file, "first", rotations=turned.as_matrix())
    pose = np.stack([rows[name].to_numpy() for name in POSE], axis=1)
    np.testing.assert_array_equal(pose[:, :3], file.positions)
    assert Rotation.from_quat(pose[:, 3:]).approx_equal(turned).all()
    assert place_rows(file, "first")["qx"].null_count == 3


def test_descriptors_of_another_distance_are_refused():
    with pytest.raises(ValueError, match="expected descriptors compared by l2, found cosine"):
        place_rows(dataclasses.replace(file_of(3), distance="cosine"), "first")


def test_without_the_extra_it_is_named(scans, monkeypatch, method):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(ImportError, match=r"expected the extra `fleet`"):
        embed_to_store("memory://x", method, opened(scans))
