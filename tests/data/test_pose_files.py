"""Pose and time files: each kind of bad line gives one error naming the file and the line."""

import numpy as np
import pytest

from sglpr_jax.data.formats.pose_files import read_poses, read_rows, read_times, rows_of

GOOD = "1 0 0 5 0 1 0 6 0 0 1 7\n"


def test_poses_are_read_row_by_row(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text(GOOD * 2)
    assert read_poses(path).shape == (2, 3, 4)
    np.testing.assert_array_equal(read_poses(path)[0, :, 3], [5, 6, 7])


def test_times_are_read(tmp_path):
    path = tmp_path / "times.txt"
    path.write_text("0.0\n1e-1\n1e-1\n\n")
    np.testing.assert_array_equal(read_times(path), [0, 0.1, 0.1])


@pytest.mark.parametrize(
    "line, found",
    [
        ("1 0 0 5\n", "expected 12 numbers, found 4"),
        ("\n", "expected 12 numbers, found 0"),
        (GOOD.replace("5", "nan"), "expected finite numbers, found 'nan'"),
        (GOOD.replace("5", "inf"), "expected finite numbers, found 'inf'"),
        (GOOD.replace("5", "five"), "expected numbers, found '1 0 0 five"),
    ],
)
def test_a_bad_line_is_named(tmp_path, line, found):
    path = tmp_path / "poses.txt"
    path.write_text(GOOD + line + GOOD)
    with pytest.raises(ValueError, match=rf"poses\.txt, line 2: {found}"):
        read_poses(path)


def test_times_must_not_run_backwards(tmp_path):
    path = tmp_path / "times.txt"
    path.write_text("0.0\n0.2\n0.1\n")
    with pytest.raises(ValueError, match=r"times\.txt, row 3: expected a time >= 0\.2, found 0\.1"):
        read_times(path)


@pytest.mark.parametrize("separator", [None, ","])
def test_comments_say_nothing(tmp_path, separator):
    path = tmp_path / "rows.txt"
    rows = "# t x\n1 2\n# a stop\n3 4\n"
    path.write_text(rows if separator is None else rows.replace(" ", separator))
    np.testing.assert_array_equal(read_rows(path, columns=2, separator=separator), [[1, 2], [3, 4]])


def test_times_are_named_by_their_row_among_comments(tmp_path):
    path = tmp_path / "times.txt"
    path.write_text("# seconds\n0\n# a stop\n1e18\n")
    with pytest.raises(ValueError, match=r"times\.txt, row 2: expected seconds, found 1e\+18"):
        read_times(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"none\.txt: expected a file with .* numbers a line, one line per frame, found none"
    ):
        read_poses(tmp_path / "none.txt")


def test_an_empty_file_has_no_poses(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("")
    assert read_poses(path).shape == (0, 3, 4)
    with pytest.raises(ValueError, match=r"poses\.txt: expected at least 1 rows \(frame 0\), found 0"):
        rows_of(["000000"], rows=0, path=path)


def test_frames_are_rows(tmp_path):
    path = tmp_path / "poses.txt"
    assert rows_of(["000000", "000052"], rows=53, path=path) == [0, 52]
    with pytest.raises(ValueError, match=r"poses\.txt: expected at least 53 rows \(frame 52\), found 52"):
        rows_of(["000000", "000052"], rows=52, path=path)
    with pytest.raises(ValueError, match="such as 000052, found 'front'"):
        rows_of(["front"], rows=52, path=path)
