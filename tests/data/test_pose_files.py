"""Pose files of every format: what they give, and one error for each way to be wrong."""

import numpy as np
import pytest

from sglpr_jax.data.formats.pose_files import read_poses, read_rows, read_trajectory, rows_of
from sglpr_jax.data.warning import DataWarning

KITTI = "1 0 0 5 0 1 0 6 0 0 1 7\n"


@pytest.fixture
def write(tmp_path):
    def write(name, text):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def test_the_camera_looks_along_z_and_the_lidar_along_x(write):
    path = write("poses.txt", KITTI * 2)
    camera, lidar = read_trajectory(path, format="kitti"), read_trajectory(path, format="lidar")
    np.testing.assert_array_equal(camera.positions, [[7, -5, -6]] * 2)
    np.testing.assert_array_equal(lidar.positions, [[5, 6, 7]] * 2)
    assert camera.source.endswith("poses.txt (camera)") and lidar.source.endswith("poses.txt (z up)")
    assert camera.times is None


def test_twelve_numbers_do_not_tell_their_frame(write):
    with pytest.raises(ValueError, match=r"poses\.txt: expected --pose-format kitti .* or lidar .*found neither"):
        read_trajectory(write("poses.txt", KITTI))


def test_tum_has_times(write):
    path = write("tum.txt", "# t x y z qx qy qz qw\n0.5 1 2 3 0 0 0 1\n0.75 4 5 6 0 0 0 1\n")
    found = read_trajectory(path)
    np.testing.assert_array_equal(found.positions, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(found.times, [0.5, 0.75])


def test_csv_is_read_by_its_header(write):
    found = read_trajectory(write("a.csv", "Z, x,name_id,y,t\n3,1,9,2,0\n6,4,9,5,1.5\n"))
    np.testing.assert_array_equal(found.positions, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(found.times, [0, 1.5])
    assert read_trajectory(write("b.csv", "x,y,z\n1,2,3\n")).times is None


@pytest.mark.parametrize("name", ["t", "time", "# Timestamp", "time_s"])
def test_a_column_of_times_has_a_name_that_says_so(write, name):
    np.testing.assert_array_equal(read_trajectory(write("a.csv", f"{name},x,y,z\n0.5,1,2,3\n")).times, [0.5])


@pytest.mark.parametrize(("names", "times"), [("x,y,Timestamps,z,t", [3.0])])
def test_a_column_that_may_be_times_and_is_not_used_is_told(write, names, times):
    with pytest.warns(DataWarning, match=r"a\.csv: expected seconds in one of t, .*, found timestamp.*, not used"):
        found = read_trajectory(write("a.csv", f"{names}\n{','.join('1233'[: names.count(',')])},3\n"))
    assert (None if found.times is None else found.times.tolist()) == times


@pytest.mark.parametrize("row", ["0 0 0 5 0 0 0 6 0 0 0 7", "1 0 0 5 0 1 0 6 0 0 -1 7"])
@pytest.mark.parametrize("format", ["kitti", "lidar"])
def test_what_is_no_rotation_is_refused(write, row, format):
    with pytest.raises(ValueError, match=rf"p\.txt: expected a rotation and a translation in row 2, found {row}"):
        read_trajectory(write("p.txt", f"{KITTI}{row}\n"), format=format)


def test_a_file_of_times_replaces_those_of_the_poses(write):
    path, times = write("a.csv", "x,y,z,t\n1,2,3,0\n4,5,6,1\n"), write("times.txt", "7\n9\n")
    np.testing.assert_array_equal(read_trajectory(path, times=times).times, [7, 9])
    with pytest.raises(ValueError, match=r"short\.txt: expected 2 times, one per pose, found 1"):
        read_trajectory(path, times=write("short.txt", "7\n"))


@pytest.mark.parametrize(
    ("name", "text", "error"),
    [
        ("empty.csv", "x,y,z\n", "expected at least one pose, found none"),
        ("bare.csv", "1,2,3\n", "expected a header with x, y and z, found '1,2,3'"),
        ("back.txt", "1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", r"expected a time >= 1\.0, found 0\.0"),
        ("zeros.txt", "0 0 0 0 0 0 0 0\n", r"rotation qx qy qz qw of length 1 in row 1, found 0 0 0 0"),
        ("far.csv", "x,y,z\n1,2,1e30\n", r"expected positions in metres, up to 1e\+08, found .* in row 1"),
        (
            "nanoseconds.csv",
            "timestamp,x,y,z\n1700000000000000000,1,2,3\n",
            r"row 1: expected seconds, found 1\.7e\+18",
        ),
        ("back.csv", "# t,x,y,z\n1,1,2,3\n# a stop\n0,1,2,3\n", r"row 2: expected a time >= 1\.0, found 0"),
        ("units.csv", "t_s,seconds,x,y,z\n1,1,1,2,3\n", "expected every column once, and one of t, .*, t_s"),
        ("half.txt", "1 0 0 0 0 0 0 1\n0 0 0\n", "line 2: expected 8 numbers, found 3"),
    ],
)
def test_a_malformed_file_is_named(write, name, text, error):
    with pytest.raises(ValueError, match=rf"{name}.*{error}"):
        read_trajectory(write(name, text))


def test_heights_that_run_as_far_as_a_road_are_told(write, recwarn):
    way = [(i * 1.0, i * 0.8, 0.01 * i) for i in range(300)]
    path = write("poses.txt", "".join(f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z}\n" for x, y, z in way))
    read_trajectory(path, format="lidar")
    assert not recwarn.list
    with pytest.warns(DataWarning, match=r"poses\.txt: expected z up, found heights over 239 m and 3 x 299 m"):
        read_trajectory(path, format="kitti")


@pytest.mark.parametrize(
    "line, found",
    [
        ("1 0 0 5\n", "expected 12 numbers, found 4"),
        (KITTI.replace("5", "nan"), "expected finite numbers, found 'nan'"),
        (KITTI.replace("5", "five"), "expected numbers, found '1 0 0 five"),
    ],
)
def test_a_bad_line_is_named(tmp_path, line, found):
    path = tmp_path / "poses.txt"
    path.write_text(KITTI + line + KITTI)
    with pytest.raises(ValueError, match=rf"poses\.txt, line 2: {found}"):
        read_poses(path)


@pytest.mark.parametrize("separator", [None, ","])
def test_comments_say_nothing(tmp_path, separator):
    path = tmp_path / "rows.txt"
    rows = "# t x\n1 2\n# a stop\n3 4\n"
    path.write_text(rows if separator is None else rows.replace(" ", separator))
    np.testing.assert_array_equal(read_rows(path, columns=2, separator=separator), [[1, 2], [3, 4]])


def test_frames_are_rows(tmp_path):
    path = tmp_path / "poses.txt"
    assert rows_of(["000000", "000052"], rows=53, path=path) == [0, 52]
    with pytest.raises(ValueError, match=r"poses\.txt: expected at least 53 rows \(frame 52\), found 52"):
        rows_of(["000000", "000052"], rows=52, path=path)
    with pytest.raises(ValueError, match="such as 000052, found 'front'"):
        rows_of(["front"], rows=52, path=path)
