"""Points from .npy and .npz files."""

import io
import zipfile

import numpy as np
import pytest

from sglpr_jax.data.formats import clouds
from sglpr_jax.data.formats.arrays import read_points

CLOUD = np.arange(12, dtype=np.float32).reshape(4, 3)


@pytest.mark.parametrize(("dtype", "more"), [(np.float32, 0), (np.float64, 1), (np.int16, 5)])
def test_rows_of_numbers(tmp_path, dtype, more):
    np.save(tmp_path / "a.npy", np.column_stack([CLOUD, np.ones((4, more))]).astype(dtype))
    points = read_points(tmp_path / "a.npy")
    np.testing.assert_array_equal(points, CLOUD)
    assert points.dtype == np.float32 and points.flags.c_contiguous


def test_records_with_names(tmp_path):
    records = np.zeros((2, 2), [("ring", "u1"), ("z", "f4"), ("x", "f8"), ("y", "f4")])
    for axis, column in zip("xyz", CLOUD.T, strict=True):
        records[axis] = column.reshape(2, 2)
    np.save(tmp_path / "a.npy", records)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy"), CLOUD)


@pytest.mark.parametrize("names", [("cloud",), ("whatever",), ("labels", "points"), ("pose", "xyz")])
def test_archives(tmp_path, names):
    np.savez(tmp_path / "a.npz", **{name: CLOUD if name == names[-1] else np.zeros(4) for name in names})
    np.testing.assert_array_equal(read_points(tmp_path / "a.npz"), CLOUD)


@pytest.mark.parametrize(
    "array",
    [np.zeros(9), np.zeros((0, 3)), np.zeros((4, 2)), np.zeros((2, 2, 3)), np.zeros((3, 4000)), np.array(["x"])],
)
def test_other_arrays_are_refused(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", array)
    for name in ("a.npy", "a.npz"):
        with pytest.raises(ValueError, match=rf"{name}: expected points as rows of 3 to 32 numbers, found"):
            read_points(tmp_path / name)


def test_several_arrays_broken_files_and_objects_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", ids=np.zeros(3), descriptors=np.zeros((3, 256)))
    with pytest.raises(ValueError, match=r"a\.npz: .*expected one array, or one named points"):
        read_points(tmp_path / "a.npz")
    np.save(tmp_path / "o.npy", np.array([{}]), allow_pickle=True)
    (tmp_path / "b.npy").write_bytes(b"\x93NUMPY\x01\x00cut")
    np.savez(tmp_path / "c.npz", points=CLOUD)
    (tmp_path / "c.npz").write_bytes((tmp_path / "c.npz").read_bytes()[:60])
    with pytest.raises(ValueError, match=r"o\.npy: expected a numpy array, .*allow_pickle=False"):
        read_points(tmp_path / "o.npy")
    for name in ("o.npy", "b.npy", "c.npz"):
        with pytest.raises(ValueError, match=rf"{name}: expected a numpy array"):
            read_points(tmp_path / name)
    with pytest.raises(FileNotFoundError, match=r"d\.npy: expected a numpy file, found none"):
        read_points(tmp_path / "d.npy")


def header_of(shape, dtype="<f4"):
    """The beginning of an .npy file."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue()


@pytest.mark.parametrize("shape", [(2**30, 3), (5, 3), (3, 3), (2**62, 2**62), (-4, 3)])
def test_headers_that_declare_another_size_than_the_file_has(tmp_path, shape):
    content = header_of(shape) + CLOUD.tobytes()
    (tmp_path / "a.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("points.npy", content)
    for name in ("a.npy", "a.npz"):
        with pytest.raises(ValueError, match=rf"{name}: expected a numpy array, .*as its header declares"):
            read_points(tmp_path / name)


def test_an_archive_that_inflates_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "MOST_BYTES", 10**6)
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("memory was allocated"))
    np.savez_compressed(tmp_path / "a.npz", points=np.zeros((10**5, 3), np.float32))
    assert (tmp_path / "a.npz").stat().st_size < 10**4
    with pytest.raises(ValueError, match=r"a\.npz: .*expected a scan of at most 1000000 bytes, found 1200128"):
        read_points(tmp_path / "a.npz")
