"""Archives of arrays: what a file declares is checked before memory is asked for."""

import io
import struct
import zipfile

import numpy as np
import pytest

from sglpr_jax.numpy_files import read_array, read_arrays


def test_arrays_come_back(tmp_path):
    arrays = {"a": np.arange(6).reshape(2, 3), "b": np.array("text"), "c": np.zeros((0, 3), np.float32)}
    np.savez(tmp_path / "a.npz", **arrays)
    np.savez_compressed(tmp_path / "b.npz", **arrays)
    for name in ("a.npz", "b.npz"):
        found = read_arrays(tmp_path / name, expected="arrays")
        assert list(found) == list(arrays)
        for key, array in arrays.items():
            np.testing.assert_array_equal(found[key], array)
            assert found[key].dtype == array.dtype


def test_a_directory_that_declares_less_than_it_holds_gives_no_array(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", zeros=np.zeros(2**20))
    content = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(content.replace(struct.pack("<I", 2**23 + 128), struct.pack("<I", 200)))
    with pytest.raises(ValueError, match=r"a\.npz: expected arrays, found a broken one: array 'zeros\.npy'"):
        read_arrays(tmp_path / "a.npz", expected="arrays")


def test_another_file_in_the_archive_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.zeros(3))
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("readme.txt", "no array")
    with pytest.raises(ValueError, match=r"a\.npz: expected arrays, found a broken one: array 'readme\.txt'"):
        read_arrays(tmp_path / "a.npz", expected="arrays")


def test_values_without_bytes_are_refused():
    """Of these, any number fits into any file."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<U0", "fortran_order": False, "shape": (2**40,)})
    size = stream.tell()
    stream.seek(0)
    with pytest.raises(ValueError, match="expected values of at least one byte, found <U0"):
        read_array(stream, size=size)
