"""Single scans of every format: points, times and lasers, one clear error for each flaw, and no memory for lies."""

import io
import math
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from clouds import las, literals, pcd, ply, records_of, stream_of

from sglpr_jax.data.formats import clouds as limits
from sglpr_jax.data.formats.pcd_ply import decompress_lzf
from sglpr_jax.data.formats.scan_files import (
    cloud_blocks,
    format_by_name,
    read_labels,
    read_scan,
    scan_id,
    scan_of_file,
)
from sglpr_jax.files import DataWarning

CLOUD = np.array([[1, 2, 3], [np.nan, np.nan, np.nan], [-4, 5.5, 6]], np.float32)
WHOLE = np.array([[1, 2, 3], [7, -8, 9], [-4, 5.5, 6]], np.float32)
TIMES = np.array([1e9, 1e9 + 0.05, 1e9 + 0.1])
PLAIN = records_of(CLOUD)
TURNED = records_of(CLOUD, "ring:u1 z:f8 timestamp:f8 y:f4 x:f4 i:f4", timestamp=TIMES)
FILES = {
    **{f"{data}.pcd": (pcd(TURNED, data), True) for data in ("binary", "binary_compressed", "ascii")},
    "carriage.pcd": (pcd(PLAIN).replace(b"\n", b"\r\n", 10), False),
    "filled.pcd": (pcd(PLAIN) + bytes(99), False),
    "nan.pcd": (pcd(PLAIN, "ascii").replace(b"nan nan nan", b"-nan(ind) nan 1.#QNAN"), False),
    **{f"text{order}.ply": (ply(TURNED, order), True) for order in ("", "<", ">")},
    "carriage.ply": (ply(PLAIN).replace(b"nan", b"-nan(ind)").replace(b"\n", b"\r\n"), False),
    "comment.ply": (ply(PLAIN).replace(b"made by a test", b"end_header follows\nobj_info mine"), False),
    "rows.npy": (stream_of(np.save, CLOUD), False),
    "wide.npy": (stream_of(np.save, np.column_stack([CLOUD, np.ones((3, 5))])), False),
    "records.npy": (stream_of(np.save, TURNED), False),
    "named.npz": (stream_of(np.savez, labels=np.zeros(4), xyz=CLOUD), False),
    "lone.npz": (stream_of(np.savez, whatever=CLOUD), False),
}
"""Content of files of all formats with a header, and whether they have times."""


def write(folder: Path, name: str, content: bytes) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


@pytest.mark.parametrize("name", FILES)
def test_every_format(tmp_path, name):
    content, timed = FILES[name]
    found = scan_of_file(write(tmp_path, name, content))
    np.testing.assert_array_equal(found.points, CLOUD)
    assert found.points.dtype == np.float32 and (found.lasers is None) == (not timed)
    assert (found.time_field is not None) == timed
    if timed:
        assert found.time_field.name == "timestamp"
        np.testing.assert_allclose(found.time_field.values, TIMES, rtol=1e-15)


@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_las_is_scaled_and_moved_as_its_header_says(tmp_path, version):
    path = write(tmp_path, "a.las", las(WHOLE, version=version, offsets=(100.0, 0, 0)))
    np.testing.assert_allclose(read_scan(path), WHOLE, atol=1e-3)


def test_records_without_a_header(tmp_path):
    (tmp_path / "velodyne_sync").mkdir()
    kitti = write(tmp_path, "0.bin", np.array([[1, 2, 3, 0.5], [4, 5, np.nan, 0.5]], "<f4").tobytes())
    np.testing.assert_array_equal(read_scan(kitti), np.float32([[1, 2, 3], [4, 5, np.nan]]))
    assert read_scan(kitti).flags.f_contiguous
    nuscenes = scan_of_file(write(tmp_path, "a.pcd.bin", np.array([[1, 2, 3, 0.5, 31]], "<f4").tobytes()))
    assert nuscenes.points.tolist() == [[2, -1, 3]] and nuscenes.lasers.tolist() == [31]
    raw = np.array([[20001, 20002, 20003], [0, 65535, 7]], "<u2")
    records = np.zeros(2, [("xyz", "<u2", 3), ("rest", "u1", 2)])
    records["xyz"], records["rest"] = raw, [[200, 5], [100, 31]]
    nclt = scan_of_file(write(tmp_path, "velodyne_sync/1.bin", records.tobytes()))
    expected = (raw.astype(np.float64) * 0.005 - 100) * [1, -1, -1]  # turned, not mirrored
    np.testing.assert_array_equal(nclt.points, expected.astype(np.float32))
    assert nclt.lasers.tolist() == [5, 31]


@pytest.mark.parametrize(
    "name, format, stem",
    [
        ("velodyne/000052.bin", None, "000052"),
        ("sweeps/a__LIDAR_TOP__1.pcd.bin", "nuscenes", "a__LIDAR_TOP__1"),
        ("velodyne_sync/1326652795280148.bin", "nclt", "1326652795280148"),
        ("clouds/16_BEAMS.PCD", "pcd", "16_BEAMS"),
        ("clouds/1.25.bin", None, "1.25"),
    ],
)
def test_format_and_id_come_from_the_name(name, format, stem):
    assert format_by_name(Path(name)) == format and scan_id(Path(name)) == stem


def array_header(shape) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def archive(content: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("points.npy", content)
    return stream.getvalue()


def changed(whole: bytes, at: int, number: float, format: str = "<I") -> bytes:
    return whole[:at] + struct.pack(format, number) + whole[at + struct.calcsize(format) :]


PACKED, TEXT, LAS = pcd(PLAIN, "binary_compressed"), ply(PLAIN), las(WHOLE)
BODY = PACKED.index(b"DATA binary_compressed\n") + 23
LIES = {(2**30, 3), (5, 3), (2**62, 2**62), (-4, 3)}
BROKEN = [
    ("0.bin", b"", r"expected 16 bytes for each point \(kitti\), found 0 bytes"),
    ("a.pcd", CLOUD.tobytes(), "expected a header"),
    ("a.pcd", pcd(PLAIN)[:-1], "expected 3 points of 16 bytes, found 47 bytes"),
    ("a.pcd", pcd(PLAIN) + CLOUD.tobytes(), "expected 3 points of 16 bytes, found 84 bytes"),
    ("a.pcd", pcd(PLAIN[:0]), "expected at least one point, found none"),
    ("a.pcd", pcd(PLAIN, "binary_packed"), "expected DATA binary, binary_compressed, ascii, found binary_packed"),
    ("a.pcd", pcd(PLAIN, FIELDS="x y z x"), "expected the fields x, y and z, found x y z x"),
    ("a.pcd", pcd(PLAIN, TYPE="F F Q F"), "expected z of TYPE F, I or U .* found TYPE Q, SIZE 4"),
    ("a.pcd", pcd(PLAIN, COUNT=f"1 1 1 {'9' * 20}"), "expected a whole number as COUNT, found '9999"),
    ("a.pcd", pcd(PLAIN, WIDTH=99999999, POINTS=99999999), "expected a scan of at most 16777216 points"),
    ("a.pcd", pcd(PLAIN, POINTS="3\nSIZE 4 4 4 2"), "each once, in the header, found 'SIZE 4 4 4 2'"),
    ("a.pcd", pcd(PLAIN, "ascii").replace(b"5.5", b"5_5"), "could not convert string '5_5'"),
    ("a.pcd", PACKED[:-4], "expected 48 bytes of 3 points in 50 bytes, found 48 in 46"),
    ("a.pcd", PACKED[: BODY + 8] + b"\xff" * 50, "expected LZF, found a reference to before the start"),
    ("a.ply", TEXT.replace(b"ply", b"obj", 1), "expected a header"),
    ("a.ply", TEXT.replace(b"vertex 3", b"point 3"), "expected an element vertex, found point"),
    ("a.ply", TEXT.replace(b"vertex 3", b"vertex 2"), "expected at most 2 lines after the header, found 3"),
    ("a.ply", TEXT.replace(b"vertex 3", b"vertex x"), "expected a whole number as number of vertex, found 'x'"),
    ("a.ply", TEXT.replace(b"property float i", b"propesty float i"), "found 'propesty float i'"),
    ("a.ply", TEXT.replace(b"float y", b"float x"), "expected the fields x, y and z, found x x z i"),
    ("a.ply", ply(PLAIN, "<").replace(b"float i", b"list uchar int i"), "expected numbers for i of vertex, found list"),
    ("a.npy", b"\x93NUMPY\x01\x00cut", "expected a readable .npy file"),
    ("a.npy", stream_of(np.save, np.array([{}]), allow_pickle=True), "allow_pickle=False"),
    ("a.npz", stream_of(np.savez, ids=CLOUD, more=CLOUD), "expected one array, or one named points"),
    *(("a.npy", array_header(shape) + CLOUD.tobytes(), "as its header declares") for shape in LIES),
    *(("a.npz", archive(array_header(shape) + CLOUD.tobytes()), "as its header declares") for shape in LIES),
    *(
        ("a.npy", stream_of(np.save, array), "expected points as rows of 3 to 32 numbers, found")
        for array in (np.zeros(9), np.zeros((0, 3)), np.zeros((4, 2)), np.zeros((3, 4000)), np.array(["x"]))
    ),
    ("a.las", LAS[:100], "expected a .las file, found an unreadable one"),
    ("a.las", changed(LAS, 131, math.nan, "<d"), "expected positive scales and finite offsets"),
    ("a.las", changed(LAS, 139, 0.0, "<d"), "expected positive scales and finite offsets"),
    ("a.las", changed(LAS, 155, math.inf, "<d"), "expected positive scales and finite offsets"),
    ("a.las", LAS[:-40], "expected 3 points by the header, found 1"),
    ("a.las", changed(LAS, 100, 2**32 - 1), "expected 4294967295 and 0 records by the header, found"),
    ("a.las", changed(LAS, 107, 2**32 - 1), "expected a scan of at most 16777216 points, found 4294967295"),
    ("a.las", changed(las(WHOLE, version="1.4"), 243, 2**32 - 1), "records by the header"),
]
"""Name and content of a broken file, and its error."""


@pytest.mark.parametrize(("name", "content", "message"), BROKEN, ids=range(len(BROKEN)))
def test_a_broken_file_is_named(tmp_path, name, content, message):
    with pytest.raises(ValueError, match=rf"^{tmp_path}/{name}: .*{message}"):
        scan_of_file(write(tmp_path, name, content))
    with pytest.raises(FileNotFoundError, match=r"none\.pcd: expected a scan, found none"):
        read_scan(tmp_path / "none.pcd")


@pytest.mark.parametrize("viewpoint", ["0 0 2 1 0 0 0", "0 0 0 0.7071068 0.7071068 0 0"])
def test_a_viewpoint_that_is_not_applied_is_told(tmp_path, viewpoint):
    path = write(tmp_path, "a.pcd", pcd(PLAIN).replace(b"DATA", f"VIEWPOINT {viewpoint}\nDATA".encode(), 1))
    with pytest.warns(DataWarning, match=rf"a\.pcd: .* its VIEWPOINT, {viewpoint}, is not applied"):
        np.testing.assert_array_equal(read_scan(path), CLOUD)
    x, y, z = CLOUD.T
    expected = [x, y, z + 2] if viewpoint.startswith("0 0 2") else [x, -z, y]  # 90 degrees about x
    np.testing.assert_allclose(read_scan(path, format="pcd-viewpoint"), np.stack(expected, axis=1), atol=1e-5)


@pytest.mark.parametrize(("viewpoint", "found"), [("0 0 2 0 0 0 0", "rotation.*found 0 0 0 0"), ("0 0", "found 2")])
def test_a_viewpoint_that_is_no_pose_is_refused_where_it_is_applied(tmp_path, viewpoint, found):
    path = write(tmp_path, "a.pcd", pcd(PLAIN).replace(b"DATA", f"VIEWPOINT {viewpoint}\nDATA".encode(), 1))
    with pytest.raises(ValueError, match=rf"a\.pcd: expected a readable \.pcd file.*{found}"):
        read_scan(path, format="pcd-viewpoint")


def test_coordinates_at_the_limit_of_las_are_left_out(tmp_path):
    far = WHOLE.astype(np.float64)
    far[1, 1] = (2**31 - 1) * 0.001
    path = write(tmp_path, "a.las", las(far))
    for read in (read_scan, lambda path: np.concatenate(list(cloud_blocks(path)))):
        with pytest.warns(DataWarning, match=r"a\.las: 1 coordinates are at the limit"):
            found = read(path)
        np.testing.assert_allclose(found[[0, 2]], WHOLE[[0, 2]], atol=1e-3)
        assert np.isnan(found[1, 1])


@pytest.mark.parametrize("data", ["binary", "binary_compressed", "ascii"])
def test_fields_without_numbers(tmp_path, data):
    """Padding, and fields with no values. The Point Cloud Library leaves padding out of text and of compressed data."""
    layout = {"FIELDS": "x _ y z _ none", "SIZE": "4 1 4 4 3 4", "TYPE": "F - F F U F", "COUNT": "1 4 1 1 1 0"}
    padded = records_of(CLOUD, "x:f4 a:f4 y:f4 z:f4 b:u2 c:u1")
    records = padded if data == "binary" else records_of(CLOUD, "x:f4 y:f4 z:f4")
    np.testing.assert_array_equal(read_scan(write(tmp_path, "a.pcd", pcd(records, data, **layout))), CLOUD)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_elements_before_and_behind_the_vertices(tmp_path, order):
    before = "element camera 2\nproperty int id\nproperty short kind\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    front = bytes(12) if order else b"1 2\n3 4\n"
    content = ply(PLAIN, order, before=before, front=front, after=faces)
    np.testing.assert_array_equal(read_scan(write(tmp_path, "a.ply", content)), CLOUD)
    if order:
        content = ply(PLAIN, order, after="element camera 1\nproperty int id\n") + bytes(4)
        np.testing.assert_array_equal(read_scan(write(tmp_path, "a.ply", content)), CLOUD)
        with pytest.raises(ValueError, match=r"expected at most 52 bytes after the header, found 53"):
            read_scan(write(tmp_path, "a.ply", content + b"1"))


def test_sizes_are_checked_before_memory_is_allocated(tmp_path, monkeypatch):
    monkeypatch.setattr(np, "fromfile", lambda *_, **__: pytest.fail("memory was allocated"))
    path = write(tmp_path, "0.bin", b"")
    with path.open("r+b") as stream:
        stream.truncate(16 * (2**24 + 1))  # a file with a hole, which takes no space
    with pytest.raises(ValueError, match=r"0\.bin: expected a scan of at most 16777216 points, found 16777217"):
        read_scan(path, format="kitti")
    content = stream_of(np.savez_compressed, points=np.zeros((10**5, 3), np.float32))
    monkeypatch.setattr(limits, "MOST_BYTES", 10**6)
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("memory was allocated"))
    with pytest.raises(ValueError, match=r"a\.npz: .*expected a scan of at most 1000000 bytes, found 1200128"):
        read_scan(write(tmp_path, "a.npz", content))


@pytest.mark.parametrize("suffix", ["pcd", "ply", "las"])
def test_a_map_is_read_in_parts(tmp_path, monkeypatch, suffix):
    points = np.random.default_rng(0).uniform(-90, 90, (2500, 3)) + np.array([1000, -2000, 40])
    records = records_of(points, "x:f8 y:f8 z:f8")
    content = {"pcd": pcd(records), "ply": ply(records, "<"), "las": las(points, offsets=(1000, -2000, 40))}[suffix]
    for module in ("clouds", "las"):
        monkeypatch.setattr(f"sglpr_jax.data.formats.{module}.BLOCK_POINTS", 1000)
    blocks = list(cloud_blocks(write(tmp_path, f"map.{suffix}", content)))
    assert [len(block) for block in blocks] == [1000, 1000, 500]
    np.testing.assert_allclose(np.concatenate(blocks), points, atol=6e-4)


@pytest.mark.parametrize("data", ["binary", "binary_compressed", "ascii"])
def test_a_map_keeps_the_digits_of_large_coordinates(tmp_path, data):
    points = WHOLE + np.array([500_000.3, 5_735_712.3, 40.0])
    path = write(tmp_path, "map.pcd", pcd(records_of(points, "x:f8 y:f8 z:f8"), data))
    np.testing.assert_allclose(np.concatenate(list(cloud_blocks(path))), points, rtol=0, atol=1e-3)


FAR = bytes(i % 251 for i in range(300))


@pytest.mark.parametrize(
    ("data", "content"),
    [
        (b"\x01ab\x20\x01", b"ababa"),  # the reference overlaps what it appends
        (b"\x02abc\xe0\x30\x02", b"abc" * 20),  # a long reference
        (literals(FAR) + b"\x41\x2b", FAR + FAR[:4]),  # a reference over more than a byte
    ],
)
def test_compressed_data(data, content):
    assert decompress_lzf(data, size=len(content)) == content


@pytest.mark.parametrize(
    ("data", "size"),
    [(b"\x05abc", 6), (b"\xe0", 9), (b"\x20\x00", 3), (b"\x00a", 2), (b"\x00a\x00b", 1)],
    ids=["cut literal", "no length", "before the beginning", "too short", "too long"],
)
def test_broken_compressed_data_is_refused(data, size):
    with pytest.raises(ValueError, match="expected"):
        decompress_lzf(data, size=size)


def test_labels_are_the_lower_16_bits(tmp_path):
    path = write(tmp_path, "0.label", np.array([40 + (7 << 16), 252], "<u4").tobytes())
    assert read_labels(path, points=2).tolist() == [40, 252]
    with pytest.raises(ValueError, match=r"0\.label: expected 3 labels of 4 bytes, .*found 8 bytes"):
        read_labels(path, points=3)


def test_real_files(shared):
    points = read_scan(shared / "data/samples/16_beams.pcd")
    assert points.shape == (32000, 3) and np.isfinite(points).all(axis=1).sum() == 25207
    path = shared / "data/samples/nclt/velodyne_sync/1326652795280148.bin"
    raw = np.frombuffer(path.read_bytes(), "u1").reshape(-1, 8)
    laser = raw[:, 7].astype(int)
    x, y, z = read_scan(path).T
    # The lasers have the data sheet's elevations negated, seen from 1.03 m: the sensor hangs upside down.
    sheet = np.where(laser % 2 == 0, -30.67, -9.33) + laser // 2 * (4 / 3)
    elevation = np.degrees(np.arctan2(z - 1.03, np.hypot(x, y)))
    assert np.median(np.abs(elevation + sheet)) < 0.05 < 1 < np.median(np.abs(elevation - sheet))
