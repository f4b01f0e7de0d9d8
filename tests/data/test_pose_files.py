"""Pose files and times of every format, their units, and one error for each way to be wrong."""

import numpy as np
import pytest

from sglpr_jax.data.formats.pose_files import read_kitti, read_rows, read_times, read_trajectory, rows_of_frames
from sglpr_jax.data.times import PER_SECOND, check_jumps, counts_rows, time_unit_problem, times_of, unit_change
from sglpr_jax.files import DataWarning

KITTI = "1 0 0 5 0 1 0 6 0 0 1 7\n"
SECONDS = np.arange(280) / 10
"""A drive at 10 Hz."""


@pytest.fixture
def write(tmp_path):
    def write(name, text):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


@pytest.mark.parametrize(
    ("name", "text", "format", "positions", "times", "said"),
    [
        ("poses.txt", KITTI * 2, "kitti", [[7, -5, -6]] * 2, None, "camera"),
        ("poses.txt", KITTI * 2, "lidar", [[5, 6, 7]] * 2, None, "z up"),
        (
            "a.txt",
            "# t x\n.5 1 2 3 0 0 0 1\n# stop\n.75 4 5 6 0 0 0 1\n",
            "auto",
            [[1, 2, 3], [4, 5, 6]],
            [0.5, 0.75],
            "TUM",
        ),
        ("a.csv", "Z, x,name_id,y,t\n3,1,9,2,0\n6,4,9,5,1.5\n", "auto", [[1, 2, 3], [4, 5, 6]], [0, 1.5], "csv"),
        ("a.csv", "# Timestamp,x,y,z\n.5,1,2,3\n", "auto", [[1, 2, 3]], [0.5], "csv"),
        ("a.csv", "time_s,x,y,z\n.5,1,2,3\n", "auto", [[1, 2, 3]], [0.5], "csv"),
        ("a.csv", "x,y,z\n1,2,3\n", "auto", [[1, 2, 3]], None, "csv"),
        ("a.csv", "\ufefft,x,y,z\n.5,1,2,3\n", "auto", [[1, 2, 3]], [0.5], "csv"),  # as Excel writes it
        ("a.txt", "\ufeff.5 1 2 3 0 0 0 1\n", "auto", [[1, 2, 3]], [0.5], "TUM"),
    ],
)
def test_every_format(write, name, text, format, positions, times, said):
    found = read_trajectory(write(name, text), format=format)
    assert found.positions.tolist() == positions and found.source.endswith(f"{name} ({said})")
    assert (None if found.times is None else found.times.tolist()) == times
    assert (found.rotations is None) == (said == "csv")


def test_a_column_that_may_be_times_and_is_not_used_is_told(write):
    with pytest.warns(DataWarning, match=r"a\.csv: expected seconds in one of t, .*, found timestamps, not used"):
        assert read_trajectory(write("a.csv", "x,y,Timestamps,z,t\n1,2,3,3,3\n")).times.tolist() == [3.0]


def test_a_file_of_times_replaces_those_of_the_poses(write):
    path, times = write("a.csv", "x,y,z,t\n1,2,3,0\n4,5,6,1\n"), write("times.txt", "7\n9\n")
    assert read_trajectory(path, times=times).times.tolist() == [7, 9]
    with pytest.raises(ValueError, match=r"short\.txt: expected 2 times, one per pose, found 1"):
        read_trajectory(path, times=write("short.txt", "7\n"))


@pytest.mark.parametrize(
    ("name", "text", "error"),
    [
        ("poses.txt", KITTI, "found 12 numbers a line; .* --pose-format .* kitti .* or lidar "),
        ("empty.csv", "x,y,z\n", "expected at least one pose, found none"),
        ("bare.csv", "1,2,3\n", "expected a header with x, y and z, found '1,2,3'"),
        ("zeros.txt", "0 0 0 0 0 0 0 0\n", r"rotation qx qy qz qw of length 1 in row 1, found 0 0 0 0"),
        ("far.csv", "x,y,z\n1,2,1e30\n", r"expected positions in metres, up to 1e\+08, found .* in row 1"),
        ("ns.csv", "timestamp,x,y,z\n1700000000000000000,1,2,3\n", r"row 1: expected seconds, found 1\.7e\+18"),
        ("back.csv", "# t,x,y,z\n1,1,2,3\n# a stop\n0,1,2,3\n", r"row 2: expected a time >= 1\.0, found 0"),
        ("units.csv", "t_s,seconds,x,y,z\n1,1,1,2,3\n", "expected every column once, and one of t, .*, t_s"),
        ("half.txt", "1 0 0 0 0 0 0 1\n0 0 0\n", "line 2: expected 8 numbers, found 3"),
    ],
)
def test_a_malformed_file_is_named(write, name, text, error):
    with pytest.raises(ValueError, match=rf"{name}.*{error}"):
        read_trajectory(write(name, text))


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("1 0 0 5\n", ", line 2: expected 12 numbers, found 4"),
        (KITTI.replace("5", "nan"), ", line 2: expected finite numbers, found 'nan'"),
        (KITTI.replace("5", "five"), ", line 2: expected numbers, found '1 0 0 five"),
        ("0 0 0 5 0 0 0 6 0 0 0 7\n", ": expected a rotation and a translation in row 2, found 0 0 0 5"),
        ("1 0 0 5 0 1 0 6 0 0 -1 7\n", ": expected a rotation and a translation in row 2, found 1 0 0 5"),
    ],
)
def test_a_bad_line_is_named(write, line, found):
    with pytest.raises(ValueError, match=rf"poses\.txt{found}"):
        read_kitti(write("poses.txt", KITTI + line + KITTI))


def test_heights_that_run_as_far_as_a_road_are_told(write, recwarn):
    way = [(i * 1.0, i * 0.8, 0.01 * i) for i in range(300)]
    path = write("poses.txt", "".join(f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z}\n" for x, y, z in way))
    read_trajectory(path, format="lidar")
    assert not recwarn.list
    with pytest.warns(DataWarning, match=r"poses\.txt: expected z up, found heights over 239 m and 3 x 299 m"):
        read_trajectory(path, format="kitti")


def test_frames_are_rows(write):
    path = write("rows.txt", "# t,x\n1,2\n# a stop\n3,4\n")
    assert read_rows(path, columns=2, separator=",").tolist() == [[1, 2], [3, 4]]
    rows = np.arange(53.0)
    assert rows_of_frames(rows, ["000000", "000052"], path=path).tolist() == [0, 52]
    with pytest.raises(ValueError, match=r"rows\.txt: expected at least 53 rows \(frame 52\), found 52"):
        rows_of_frames(rows[:52], ["000000", "000052"], path=path)
    with pytest.raises(ValueError, match="such as 000052, found 'front'"):
        rows_of_frames(rows, ["front"], path=path)


@pytest.mark.parametrize("start", [0.0, 12.5, 1.7e9])
@pytest.mark.parametrize("hertz", [0.1, 1, 9.6, 400])
def test_seconds_of_lidars_keyframes_and_odometry_are_kept(start, hertz):
    times = start + 0.003 + np.arange(40) / hertz
    np.testing.assert_array_equal(times_of(times, source="a"), times)


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("hertz", [0.5, 95])
def test_other_units_are_refused_and_named_and_converted_if_stated(unit, hertz):
    times = np.arange(40) / hertz
    with pytest.raises(ValueError, match=r"a\.txt: expected times in seconds, found steps of .*--time-unit"):
        times_of(times * PER_SECOND[unit], source="a.txt")
    np.testing.assert_allclose(times_of(times * PER_SECOND[unit], source="a.txt", unit=unit), times)
    with pytest.raises(ValueError, match=r"a\.txt, row 1: expected seconds, found 1\.7e\+.*smaller unit.*--time-unit"):
        times_of((1.7e9 + times) * PER_SECOND[unit], source="a.txt")


@pytest.mark.parametrize("first", [0, 1])
def test_numbers_of_rows_and_of_keyframes_are_not_times(first):
    rows = np.arange(first, first + 280.0)
    assert counts_rows(rows) and times_of(rows, source="a") is None
    np.testing.assert_array_equal(times_of(rows, source="a", unit="s"), rows)
    assert not counts_rows(rows[:-1] + np.arange(279) / 1e4) and not counts_rows(np.array([5.0, 6.0]))
    with pytest.raises(ValueError, match="expected times in seconds, found whole numbers from 70 to 349, as of frames"):
        times_of(70 + np.arange(0.0, 280, 3), source="a")
    epoch = 1.7e9 + np.arange(50)
    np.testing.assert_array_equal(times_of(epoch, source="a"), epoch)


def test_few_steps_stops_pauses_and_new_clocks_prove_nothing():
    stops = np.repeat(SECONDS, 3) + np.repeat(np.arange(28), 30) * 60.0
    for times in (np.array([0.0, 500.0, 900.0]), np.zeros(50), np.zeros(0), stops):
        assert time_unit_problem(times) == ""
    for later in (1e4 + SECONDS, 1.7e9 + SECONDS, 100 + 100 * SECONDS, np.array([28e9, 28.1e9])):
        times = np.append(SECONDS, later)
        np.testing.assert_array_equal(times_of(times, source="a", unit="s"), times)
    assert unit_change(np.zeros(9)) is None and unit_change(-SECONDS[::-1]) is None
    check_jumps(np.array([0.0, 600.0, 1200.0]), source="stops")


@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize(("row", "factor"), [(3, 1e3), (140, 1e6), (277, 1e9)])
def test_a_unit_that_changes_in_the_middle_is_refused_whatever_unit_is_stated(start, row, factor):
    times = start + SECONDS
    times[row:] *= factor
    for unit in PER_SECOND:
        with pytest.raises(ValueError, match=rf"a\.txt, row {row + 1}: expected times in one unit, .* times as l"):
            times_of(times, source="a.txt", unit=unit)


def test_every_file_of_times_follows_the_rule(write):
    numbers = "".join(f"{100 * i}\n" for i in range(9))
    rows, tum = write("times.txt", numbers), write("poses.tum", numbers.replace("\n", " 0 0 0 0 0 0 1\n"))
    table = write("poses.csv", "t,x,y,z\n" + numbers.replace("\n", ",0,0,0\n"))
    for read, path in ((read_times, rows), (read_trajectory, tum), (read_trajectory, table)):
        with pytest.raises(ValueError, match=rf"{path.name}: expected times in seconds, found steps"):
            read(path)
    np.testing.assert_allclose(read_times(rows, unit="ms"), np.arange(9) / 10)
    for path in (tum, table):
        np.testing.assert_allclose(read_trajectory(path, times=rows, time_unit="ms").times, np.arange(9) / 10)
    with pytest.warns(DataWarning, match=r"n\.txt: expected times, found row numbers .*not used; state the unit"):
        assert read_times(write("n.txt", "0\n1\n2\n")) is None
