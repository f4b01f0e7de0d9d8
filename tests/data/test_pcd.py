"""Point clouds of the Point Cloud Library: binary, compressed and text, any order of fields, NaN points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.formats.pcd import decompress_lzf, pcd_records

HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS {fields}
SIZE {sizes}
TYPE {types}
COUNT {counts}
WIDTH {points}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {points}
DATA {data}
"""
XYZI = {"fields": "x y z intensity", "sizes": "4 4 4 4", "types": "F F F F", "counts": "1 1 1 1", "points": 3}
CLOUD = np.array([[1, 2, 3, 0.5], [np.nan, np.nan, np.nan, -1], [-4, 5.5, 6, 0.25]], dtype="<f4")


def read_pcd(path):
    return pcd_records(path).points


def write(path, body: bytes, **changed):
    path.write_bytes(HEADER.format(**(XYZI | {"data": "binary"} | changed)).encode() + body)
    return path


def test_binary_with_points_that_are_not_numbers(tmp_path):
    points = read_pcd(write(tmp_path / "a.pcd", CLOUD.tobytes()))
    np.testing.assert_array_equal(points, CLOUD[:, :3])
    assert points.dtype == np.float32


def test_binary_with_padding_and_double_fields(tmp_path):
    record = np.dtype([("ring", "<u2"), ("_", "u1", 6), ("z", "<f8"), ("y", "<f8"), ("x", "<f8")])
    cloud = np.zeros(2, dtype=record)
    cloud["x"], cloud["y"], cloud["z"] = [1, 2], [3, 4], [5, 6]
    layout = {"fields": "ring _ z y x", "sizes": "2 1 8 8 8", "types": "U U f F F", "counts": "1 6 1 1 1", "points": 2}
    np.testing.assert_array_equal(
        read_pcd(write(tmp_path / "a.pcd", cloud.tobytes(), **layout)), [[1, 3, 5], [2, 4, 6]]
    )


def test_ascii_with_nan_as_windows_spells_it(tmp_path):
    body = b"1 2 3 0.5\n-nan(ind) nan 1.#QNAN -1\n-4 5.5 6 0.25\n"
    np.testing.assert_array_equal(read_pcd(write(tmp_path / "a.pcd", body, data="ascii")), CLOUD[:, :3])


EMPTY_FIELD = {"fields": "none x y z", "sizes": "4 4 4 4", "types": "F F F F", "counts": "0 1 1 1"}
PADDED = {"fields": "x _ y z _", "sizes": "4 1 4 4 3", "types": "F - F F U", "counts": "1 4 1 1 1"}


@pytest.mark.parametrize("data", ["binary", "binary_compressed", "ascii"])
@pytest.mark.parametrize("layout", [EMPTY_FIELD, PADDED], ids=["empty field", "padding left out"])
def test_fields_without_numbers(tmp_path, data, layout):
    """The Point Cloud Library leaves padding out of text and of compressed data."""
    columns = CLOUD[:, :3].T.tobytes()
    padded = np.zeros(3, [("x", "f4"), ("_", "u1", 4), ("y", "f4"), ("z", "f4"), ("more", "u1", 3)])
    padded["x"], padded["y"], padded["z"] = CLOUD[:, :3].T
    body = {
        "binary": padded.tobytes() if layout is PADDED else CLOUD[:, :3].tobytes(),
        "binary_compressed": compressed(columns),
        "ascii": b"1 2 3\nnan nan nan\n-4 5.5 6\n",
    }[data]
    np.testing.assert_array_equal(read_pcd(write(tmp_path / "a.pcd", body, data=data, **layout)), CLOUD[:, :3])


def test_the_end_may_be_filled_with_zeros_but_not_with_points(tmp_path):
    np.testing.assert_array_equal(read_pcd(write(tmp_path / "a.pcd", CLOUD.tobytes() + bytes(99))), CLOUD[:, :3])
    with pytest.raises(ValueError, match=r"a\.pcd: .*expected 3 points of 16 bytes, found 64 bytes"):
        read_pcd(write(tmp_path / "a.pcd", CLOUD.tobytes() + CLOUD[:1].tobytes()))


def test_lines_may_end_with_carriage_returns(tmp_path):
    path = tmp_path / "a.pcd"
    path.write_bytes(HEADER.format(**XYZI, data="binary").replace("\n", "\r\n").encode() + CLOUD.tobytes())
    np.testing.assert_array_equal(read_pcd(path), CLOUD[:, :3])


@pytest.mark.parametrize(
    ("body", "changed", "message"),
    [
        (b"", {}, "expected 3 points of 16 bytes, found 0 bytes"),
        (b"", {"points": 0}, "expected at least one point, found none"),
        (b"", {"data": "binary_packed"}, "expected DATA binary, binary_compressed, ascii, found binary_packed"),
        (b"", {"fields": "x y z x"}, "expected the fields x, y and z, found x y z x"),
        (b"", {"sizes": "4 4 4"}, "expected one SIZE, TYPE and COUNT for each of 4 FIELDS"),
        (b"", {"types": "F F Q F"}, "expected z of TYPE F, I or U and SIZE 1 to 8, .* found TYPE Q, SIZE 4"),
        (b"", {"fields": ""}, "found no FIELDS"),
        (b"", {"counts": "1 1 1 99999999999999999999"}, "expected a whole number as COUNT, found '9999"),
        (b"", {"counts": "1 1 1 999999999999"}, "expected a scan of at most 536870912 bytes, found"),
        (b"", {"points": 99999999}, "expected a scan of at most 16777216 points, found 99999999"),
        (b"", {"counts": "1 1 0 1"}, "expected z of .* found TYPE F, SIZE 4 and COUNT 0"),
        (b"", {"points": "3\nSIZE 4 4 4 2"}, "each once, in the header, found 'SIZE 4 4 4 2'"),
        (b"1 2 3 4\n1 2 3 4\n1 2 3_0 4\n", {"data": "ascii"}, "could not convert string '3_0'"),
        (b"1 2 3 4\n", {"data": "ascii"}, "expected 3 lines of 4 numbers, found 1 lines"),
    ],
)
def test_a_bad_file_is_named(tmp_path, body, changed, message):
    with pytest.raises(ValueError, match=rf"a\.pcd: .*{message}"):
        read_pcd(write(tmp_path / "a.pcd", body, **changed))


def test_a_file_without_a_header_is_named(tmp_path):
    path = tmp_path / "a.pcd"
    path.write_bytes(CLOUD.tobytes())
    with pytest.raises(ValueError, match=r"a\.pcd: .*expected a header"):
        read_pcd(path)
    with pytest.raises(FileNotFoundError, match=r"b\.pcd: expected a \.pcd file, found none"):
        read_pcd(tmp_path / "b.pcd")


def test_a_real_file(shared):
    points = read_pcd(shared / "data/samples/16_beams.pcd")
    assert points.shape == (32000, 3)
    assert np.isfinite(points).all(axis=1).sum() == 25207


def compressed(columns: bytes, *, size: int | None = None) -> bytes:
    """The body of a binary_compressed file, all literals."""
    packed = bytearray()
    for start in range(0, len(columns), 32):
        run = columns[start : start + 32]
        packed += bytes([len(run) - 1]) + run
    return np.array([len(packed), len(columns) if size is None else size], "<u4").tobytes() + bytes(packed)


def test_binary_compressed_has_one_field_after_another(tmp_path):
    columns = np.concatenate([CLOUD[:, 2], CLOUD[:, 3], CLOUD[:, 0], CLOUD[:, 1]]).tobytes()
    path = write(tmp_path / "a.pcd", compressed(columns), data="binary_compressed", fields="z intensity x y")
    np.testing.assert_array_equal(read_pcd(path), CLOUD[:, :3])


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"\x01", "expected two sizes before the points, found 1 bytes"),
        (compressed(CLOUD.tobytes(), size=64), "expected 48 bytes of 3 points in 50 bytes, found 64 in 50"),
        (compressed(CLOUD.tobytes())[:-4], "expected 48 bytes of 3 points in 50 bytes, found 48 in 46"),
        (compressed(CLOUD.tobytes())[:8] + b"\xff" * 50, "expected LZF, found a reference to before the start"),
    ],
)
def test_a_broken_compressed_file_is_named(tmp_path, body, message):
    with pytest.raises(ValueError, match=rf"a\.pcd: expected a readable \.pcd file, found an invalid one: {message}"):
        read_pcd(write(tmp_path / "a.pcd", body, data="binary_compressed"))


def compress(data: bytes) -> bytes:
    """LZF of `data`: at each place the longest copy among the last few hundred bytes, else a literal."""
    out, literals, at = bytearray(), bytearray(), 0

    def flush():
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.extend(bytes([len(run) - 1]) + run)
        literals.clear()

    while at < len(data):
        length, offset = 0, 0
        for back in range(1, min(at, 400) + 1):
            n = 0
            while n < 264 and at + n < len(data) and data[at - back + n] == data[at + n]:
                n += 1
            if n > length:
                length, offset = n, back - 1
        if length < 3:
            literals.append(data[at])
            at += 1
            continue
        flush()
        short = length - 2
        out.append((min(short, 7) << 5) | offset >> 8)
        if short >= 7:
            out.append(short - 7)
        out.append(offset & 255)
        at += length
    flush()
    return bytes(out)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([b"a", b"ab", b"xyz", bytes(40), b"\x00\x01\x02"]), max_size=60).map(b"".join))
def test_what_was_compressed_comes_back(data):
    assert decompress_lzf(compress(data), size=len(data)) == data


@pytest.mark.parametrize(
    ("data", "size"),
    [(b"\x05abc", 6), (b"\xe0", 9), (b"\x20", 3), (b"\x20\x00", 3), (b"\x00a", 2), (b"\x00a\x00b", 1), (b"", 1)],
    ids=["cut literal", "no length", "no offset", "before the beginning", "too short", "too long", "nothing"],
)
def test_broken_data_is_refused(data, size):
    with pytest.raises(ValueError, match="expected"):
        decompress_lzf(data, size=size)
