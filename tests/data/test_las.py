"""Points from .las files, and headers that declare more than the file holds."""

import struct

import laspy
import numpy as np
import pytest
from laspy.vlrs.vlrlist import VLRList

from sglpr_jax.data.formats.las import las_records

CLOUD = np.arange(12, dtype=np.float32).reshape(4, 3)


def write_las(path, points):
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [0.001] * 3, [100.0, 0, 0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(path)
    return path


def test_las_is_scaled_and_moved_as_its_header_says(tmp_path):
    path = write_las(tmp_path / "a.las", CLOUD.astype(np.float64))
    np.testing.assert_allclose(las_records(path).points, CLOUD, atol=1e-3)
    whole = path.read_bytes()
    path.write_bytes(whole[:-68])
    with pytest.raises(ValueError, match=r"a\.las: expected 4 points by the header, found 2"):
        las_records(path)
    path.write_bytes(whole[:100])
    with pytest.raises(ValueError, match=r"a\.las: expected a \.las file, found an unreadable one"):
        las_records(path)
    with pytest.raises(ValueError, match=r"e\.las: expected at least one point"):
        las_records(write_las(tmp_path / "e.las", np.zeros((0, 3))))
    with pytest.raises(FileNotFoundError, match=r"d\.las: expected a \.las file, found none"):
        las_records(tmp_path / "d.las")


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
        las_records(path)


@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_every_version_of_las(tmp_path, version):
    las = laspy.LasData(laspy.LasHeader(point_format=6 if version == "1.4" else 3, version=version))
    las.x, las.y, las.z = CLOUD.astype(np.float64).T
    las.vlrs.append(laspy.VLR("mine", 7, "a record", b"12345"))
    if version == "1.4":
        las.evlrs = VLRList([laspy.VLR("mine", 8, "behind the points", b"12345")])
    las.write(tmp_path / "a.las")
    np.testing.assert_allclose(las_records(tmp_path / "a.las").points, CLOUD, atol=0.01)
    whole = bytearray((tmp_path / "a.las").read_bytes())
    if version == "1.4":
        whole[243:247] = struct.pack("<I", 2**32 - 1)
        (tmp_path / "a.las").write_bytes(whole)
        with pytest.raises(ValueError, match=r"a\.las: expected 1 and 4294967295 records by the header"):
            las_records(tmp_path / "a.las")
