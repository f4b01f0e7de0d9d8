"""Vertices of .ply files: text and both byte orders, any properties around x, y and z, elements in front."""

import numpy as np
import pytest

from sglpr_jax.data.formats.ply import ply_records

CLOUD = np.array([[1, 2, 3], [np.nan, np.nan, np.nan], [-4, 5.5, 6]], np.float32)
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
HEADER = """ply
format {format} 1.0
comment made by a test
{before}element vertex {count}
property uchar ring
property float x
property float y
property double z
property float32 intensity
{after}end_header
"""


def read_ply(path):
    return ply_records(path).points


def write(path, *, format="ascii", before="", after="", front=b"", count=3):
    header = HEADER.format(format=format, before=before, after=after, count=count).encode()
    if format == "ascii":
        body = "\n".join(f"7 {x} {y} {z} 0.5" for x, y, z in CLOUD).encode() + b"\n"
    else:
        order = ORDERS[format]
        kinds = [("ring", "u1"), *((axis, f"{order}f4") for axis in "xy"), ("z", f"{order}f8"), ("i", f"{order}f4")]
        records = np.zeros(3, kinds)
        for axis, column in zip("xyz", CLOUD.T, strict=True):
            records[axis] = column
        body = records.tobytes()
    path.write_bytes(header + front + body)
    return path


@pytest.mark.parametrize("format", ["ascii", *ORDERS])
def test_every_encoding(tmp_path, format):
    points = read_ply(write(tmp_path / "a.ply", format=format))
    np.testing.assert_array_equal(points, CLOUD)
    assert points.dtype == np.float32


@pytest.mark.parametrize("format", ["ascii", *ORDERS])
def test_elements_in_front_and_behind(tmp_path, format):
    before = "element camera 2\nproperty int id\nproperty short kind\n"
    after = "element face 1\nproperty list uchar int vertex_indices\n"
    front = b"1 2\n3 4\n" if format == "ascii" else bytes(12)
    path = write(tmp_path / "a.ply", format=format, before=before, after=after, front=front)
    np.testing.assert_array_equal(read_ply(path), CLOUD)


@pytest.mark.parametrize("format", ["ascii", *ORDERS])
def test_a_comment_that_names_the_end_and_a_property_twice(tmp_path, format):
    path = write(tmp_path / "a.ply", format=format)
    header = path.read_bytes().replace(b"comment made by a test", b"comment end_header follows\nobj_info mine")
    path.write_bytes(header.replace(b"uchar ring", b"uchar intensity"))
    np.testing.assert_array_equal(read_ply(path), CLOUD)


@pytest.mark.parametrize("format", ORDERS)
def test_a_binary_file_ends_with_its_last_element(tmp_path, format):
    after = "element camera 1\nproperty int id\n"
    path = write(tmp_path / "a.ply", format=format, after=after)
    whole = path.read_bytes() + bytes(4)
    path.write_bytes(whole)
    np.testing.assert_array_equal(read_ply(path), CLOUD)
    path.write_bytes(whole + b"1")
    with pytest.raises(ValueError, match=r"a\.ply: .*expected at most 67 bytes after the header, found 68"):
        read_ply(path)


def test_nan_as_windows_spells_it_and_carriage_returns(tmp_path):
    path = write(tmp_path / "a.ply")
    path.write_bytes(path.read_bytes().replace(b" nan", b" -nan(ind)").replace(b"\n", b"\r\n"))
    np.testing.assert_array_equal(read_ply(path), CLOUD)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace(b"ply", b"obj", 1), "expected a header"),
        (lambda text: text.replace(b"ascii", b"utf9"), "expected format ascii"),
        (lambda text: text.replace(b"vertex 3", b"point 3"), "expected an element vertex, found point"),
        (lambda text: text.replace(b"vertex 3", b"vertex 0"), "expected at least one point, found none"),
        (lambda text: text.replace(b"vertex 3", b"vertex 4"), "expected 4 lines of 5 numbers, found 3"),
        (
            lambda text: text.replace(b"vertex 3", b"vertex three"),
            "whole number as number of vertex, found 'three'",
        ),
        (lambda text: text.replace(b"vertex 3", b"vertex 99999999"), "expected a scan of at most 16777216 points"),
        (lambda text: text.replace(b"vertex 3", b"vertex 2"), "expected at most 2 lines after the header, found 3"),
        (lambda text: text.replace(b"property float32", b"propesty float32"), "found 'propesty float32 intensity'"),
        (lambda text: text.replace(b"comment", b"format ascii 1.0\ncomment"), "found ascii and ascii"),
        (lambda text: text.replace(b"float y", b"float x"), "expected vertices with x, y and z, found ring x x"),
        (lambda text: text.replace(b"5.5", b"5_5"), "could not convert string '5_5'"),
    ],
)
def test_what_is_no_ply_is_named(tmp_path, change, message):
    path = write(tmp_path / "a.ply")
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ValueError, match=rf"a\.ply: expected a readable \.ply file, found an invalid one: .*{message}"):
        read_ply(path)


def test_a_cut_off_binary_and_a_list_among_the_coordinates(tmp_path):
    path = write(tmp_path / "a.ply", format="binary_little_endian")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"expected 3 points of 21 bytes, found 62 bytes"):
        read_ply(path)
    path = write(tmp_path / "b.ply", format="binary_little_endian")
    path.write_bytes(path.read_bytes().replace(b"property float32 i", b"property list uchar int i"))
    with pytest.raises(ValueError, match=r"expected numbers for intensity of vertex, found list uchar int"):
        read_ply(path)
    with pytest.raises(FileNotFoundError, match=r"c\.ply: expected a \.ply file, found none"):
        read_ply(tmp_path / "c.ply")
