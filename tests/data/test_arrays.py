"""Points from .npy, .npz and .las files, and folders in which such files are something else."""

import io
import struct
import zipfile

import laspy
import numpy as np
import pytest
from laspy.vlrs.vlrlist import VLRList

from sglpr_jax.data.formats import cloud_text
from sglpr_jax.data.formats.arrays import read_npy, read_npz
from sglpr_jax.data.formats.las import read_las
from sglpr_jax.data.readers.scan_folder import open_recording

CLOUD = np.arange(12, dtype=np.float32).reshape(4, 3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
@pytest.mark.parametrize("more", [0, 1, 5])
def test_rows_of_numbers(tmp_path, dtype, more):
    np.save(tmp_path / "a.npy", np.column_stack([CLOUD, np.ones((4, more))]).astype(dtype))
    points = read_npy(tmp_path / "a.npy")
    np.testing.assert_array_equal(points, CLOUD)
    assert points.dtype == np.float32 and points.flags.c_contiguous


def test_records_with_names(tmp_path):
    records = np.zeros((2, 2), [("ring", "u1"), ("z", "f4"), ("x", "f8"), ("y", "f4")])
    for axis, column in zip("xyz", CLOUD.T, strict=True):
        records[axis] = column.reshape(2, 2)
    np.save(tmp_path / "a.npy", records)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), CLOUD)


@pytest.mark.parametrize("names", [("cloud",), ("whatever",), ("labels", "points"), ("pose", "xyz")])
def test_archives(tmp_path, names):
    np.savez(tmp_path / "a.npz", **{name: CLOUD if name == names[-1] else np.zeros(4) for name in names})
    np.testing.assert_array_equal(read_npz(tmp_path / "a.npz"), CLOUD)


@pytest.mark.parametrize(
    "array",
    [np.zeros(9), np.zeros((0, 3)), np.zeros((4, 2)), np.zeros((2, 2, 3)), np.zeros((3, 4000)), np.array(["x"])],
)
def test_other_arrays_are_refused(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", array)
    for read, name in ((read_npy, "a.npy"), (read_npz, "a.npz")):
        with pytest.raises(ValueError, match=rf"{name}: expected points as rows of 3 to 32 numbers, found"):
            read(tmp_path / name)


def test_several_arrays_broken_files_and_objects_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", ids=np.zeros(3), descriptors=np.zeros((3, 256)))
    with pytest.raises(ValueError, match=r"a\.npz: expected one array, or one named points, .* found ids, descriptors"):
        read_npz(tmp_path / "a.npz")
    np.save(tmp_path / "o.npy", np.array([{}]), allow_pickle=True)
    (tmp_path / "b.npy").write_bytes(b"\x93NUMPY\x01\x00cut")
    np.savez(tmp_path / "c.npz", points=CLOUD)
    (tmp_path / "c.npz").write_bytes((tmp_path / "c.npz").read_bytes()[:60])
    with pytest.raises(ValueError, match=r"o\.npy: expected a numpy array, .*allow_pickle=False"):
        read_npy(tmp_path / "o.npy")
    for name, read in (("o.npy", read_npy), ("b.npy", read_npy), ("c.npz", read_npz)):
        with pytest.raises(ValueError, match=rf"{name}: expected a numpy array"):
            read(tmp_path / name)
    with pytest.raises(FileNotFoundError, match=r"d\.npy: expected a numpy file, found none"):
        read_npy(tmp_path / "d.npy")


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
    for read, name in ((read_npy, "a.npy"), (read_npz, "a.npz")):
        with pytest.raises(ValueError, match=rf"{name}: expected a numpy array, .*as its header declares"):
            read(tmp_path / name)


def test_an_archive_that_inflates_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(cloud_text, "MOST_BYTES", 10**6)
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("memory was allocated"))
    np.savez_compressed(tmp_path / "a.npz", points=np.zeros((10**5, 3), np.float32))
    assert (tmp_path / "a.npz").stat().st_size < 10**4
    with pytest.raises(ValueError, match=r"a\.npz: .*expected a scan of at most 1000000 bytes, found 1200128"):
        read_npz(tmp_path / "a.npz")


def test_other_files_in_an_archive_are_no_arrays(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("points.txt", b"1 2 3")
    with pytest.raises(ValueError, match=r"a\.npz: expected one array, or one named points, .* found none"):
        read_npz(tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("lidar.npy", header_of((4, 3)) + CLOUD.tobytes())
    np.testing.assert_array_equal(read_npz(tmp_path / "a.npz"), CLOUD)


def write_las(path, points):
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [0.001] * 3, [100.0, 0, 0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(path)
    return path


def test_las_is_scaled_and_moved_as_its_header_says(tmp_path):
    path = write_las(tmp_path / "a.las", CLOUD.astype(np.float64))
    np.testing.assert_allclose(read_las(path), CLOUD, atol=1e-3)
    whole = path.read_bytes()
    path.write_bytes(whole[:-68])
    with pytest.raises(ValueError, match=r"a\.las: expected 4 points by the header, found 2"):
        read_las(path)
    path.write_bytes(whole[:100])
    with pytest.raises(ValueError, match=r"a\.las: expected a \.las file, found an unreadable one"):
        read_las(path)
    with pytest.raises(ValueError, match=r"e\.las: expected at least one point"):
        read_las(write_las(tmp_path / "e.las", np.zeros((0, 3))))
    with pytest.raises(FileNotFoundError, match=r"d\.las: expected a \.las file, found none"):
        read_las(tmp_path / "d.las")


@pytest.mark.parametrize(
    ("at", "number", "message"),
    [
        (100, 2**32 - 1, "expected 4294967295 and 0 records by the header, found 363 bytes in total"),
        (107, 2**32 - 1, "expected a scan of at most 16777216 points, found 4294967295"),
        (107, 5, "expected 5 points by the header, found 4"),
        (107, 3, "expected 3 points by the header, found 4"),
        (96, 2**32 - 1, "expected 4 points by the header, found 0"),
    ],
    ids=["records", "points", "one more", "one less", "offset"],
)
def test_a_las_header_that_lies_is_refused(tmp_path, monkeypatch, at, number, message):
    path = write_las(tmp_path / "a.las", CLOUD.astype(np.float64))
    whole = bytearray(path.read_bytes())
    whole[at : at + 4] = struct.pack("<I", number)
    path.write_bytes(whole)
    monkeypatch.setattr(laspy, "open", lambda path: pytest.fail("the file was read"))
    with pytest.raises(ValueError, match=rf"a\.las: {message}"):
        read_las(path)


@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_every_version_of_las(tmp_path, version):
    las = laspy.LasData(laspy.LasHeader(point_format=6 if version == "1.4" else 3, version=version))
    las.x, las.y, las.z = CLOUD.astype(np.float64).T
    las.vlrs.append(laspy.VLR("mine", 7, "a record", b"12345"))
    if version == "1.4":
        las.evlrs = VLRList([laspy.VLR("mine", 8, "behind the points", b"12345")])
    las.write(tmp_path / "a.las")
    np.testing.assert_allclose(read_las(tmp_path / "a.las"), CLOUD, atol=0.01)
    whole = bytearray((tmp_path / "a.las").read_bytes())
    if version == "1.4":
        whole[243:247] = struct.pack("<I", 2**32 - 1)
        (tmp_path / "a.las").write_bytes(whole)
        with pytest.raises(ValueError, match=r"a\.las: expected 1 and 4294967295 records by the header"):
            read_las(tmp_path / "a.las")


@pytest.mark.parametrize("ending", ["npy", "npz", "las"])
def test_a_folder_of_them_is_a_recording(tmp_path, ending):
    for i in range(2):
        if ending == "las":
            write_las(tmp_path / f"{i}.las", CLOUD.astype(np.float64))
        else:
            {"npy": np.save, "npz": np.savez}[ending](tmp_path / f"{i}.{ending}", CLOUD)
    recording = open_recording(tmp_path)
    assert recording.ids == ("0", "1") and recording.found == (f"format: {ending}",)
    np.testing.assert_allclose(recording.points(1), CLOUD, atol=1e-3)


def test_beside_other_scans_arrays_are_none(tmp_path):
    CLOUD.tofile(tmp_path / "0.bin")
    np.savez(tmp_path / "mine.npz", about=np.zeros(3))
    recording = open_recording(tmp_path)
    assert recording.ids == ("0",) and recording.found[-1] == "left aside: 1 .npz"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["npy", "npz", "las"])
def test_no_flipped_byte_comes_through_as_another_error(tmp_path, kind):
    """Each byte of the headers changed in turn: points, or one ValueError that names the file."""
    path = tmp_path / f"a.{kind}"
    {"npy": np.save, "npz": np.savez, "las": lambda path, points: write_las(path, points.astype(np.float64))}[kind](
        path, CLOUD
    )
    whole, read = path.read_bytes(), {"npy": read_npy, "npz": read_npz, "las": read_las}[kind]
    refused = 0
    for at in range(0, len(whole), 1 if kind == "npy" else 3):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x15]) + whole[at + 1 :])
        try:
            assert read(path).shape[1] == 3
        except ValueError as error:
            refused += 1
            assert str(error).startswith(str(path))
    assert refused > 5
