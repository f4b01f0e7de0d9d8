"""Times in seconds are kept, row numbers are dropped, and other units are one clear error unless they are stated."""

import numpy as np
import pytest

from sglpr_jax.data.formats.pose_files import read_times, read_trajectory, read_tum
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.times import PER_SECOND, check_jumps, counts_rows, doubt, times_of, unit_change
from sglpr_jax.data.warning import DataWarning

SECONDS = np.arange(280) / 10
"""A drive at 10 Hz."""
UNITS = {"ms": "steps of 100, which fit milliseconds", "us": "100000, .*microseconds", "ns": r"1e\+08, .*nanoseconds"}


@pytest.mark.parametrize("start", [0.0, 12.5, 1.7e9])
@pytest.mark.parametrize("hertz", [0.1, 1, 9.6, 400])
def test_seconds_of_lidars_keyframes_and_odometry_are_kept(start, hertz):
    times = start + 0.003 + np.arange(40) / hertz
    np.testing.assert_array_equal(times_of(times, source="a"), times)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("hertz", [0.5, 95])
def test_other_units_are_refused_and_named_and_converted_if_stated(unit, hertz):
    times = np.arange(40) / hertz
    with pytest.raises(ValueError, match=r"a\.txt: expected times in seconds, found steps of .*--time-unit"):
        times_of(times * PER_SECOND[unit], source="a.txt")
    np.testing.assert_allclose(times_of(times * PER_SECOND[unit], source="a.txt", unit=unit), times)
    with pytest.raises(ValueError, match=r"a\.txt, row 1: expected seconds, found 1\.7e\+.*smaller unit.*--time-unit"):
        times_of((1.7e9 + times) * PER_SECOND[unit], source="a.txt")


@pytest.mark.parametrize("first", [0, 1])
def test_row_numbers_are_not_times_unless_seconds_are_stated(first):
    rows = np.arange(first, first + 280.0)
    assert counts_rows(rows) and times_of(rows, source="a") is None
    np.testing.assert_array_equal(times_of(rows, source="a", unit="s"), rows)
    assert not counts_rows(rows[:-1] + np.arange(279) / 1e4) and not counts_rows(np.array([5.0, 6.0]))


def test_numbers_of_keyframes_are_not_seconds():
    with pytest.raises(ValueError, match="expected times in seconds, found whole numbers from 70 to 349, as of frames"):
        times_of(70 + np.arange(0.0, 280, 3), source="a")
    epoch = 1.7e9 + np.arange(50)
    np.testing.assert_array_equal(times_of(epoch, source="a"), epoch)


def test_few_steps_and_stops_prove_nothing():
    assert doubt(np.array([0.0, 500.0, 900.0])) == "" and doubt(np.zeros(50)) == "" and doubt(np.zeros(0)) == ""
    stops = np.repeat(SECONDS, 3) + np.repeat(np.arange(28), 30) * 60.0
    assert doubt(stops) == ""


@pytest.mark.parametrize("start", [0.0, 12.5, 1.7e9])
@pytest.mark.parametrize(("row", "factor"), [(3, 1e3), (140, 1e6), (277, 1e9)])
def test_a_unit_that_changes_in_the_middle_is_refused_whatever_unit_is_stated(start, row, factor):
    times = start + SECONDS
    times[row:] *= factor
    for unit in PER_SECOND:
        with pytest.raises(
            ValueError, match=rf"a\.txt, row {row + 1}: expected times in one unit, found .* times as l"
        ):
            times_of(times, source="a.txt", unit=unit)
    assert doubt(times).endswith("times as large")


def test_a_pause_a_new_clock_and_another_rate_are_no_change_of_the_unit():
    for later in (1e4 + SECONDS, 1.7e9 + SECONDS, 100 + 100 * SECONDS, np.array([28e9, 28.1e9])):
        times = np.append(SECONDS, later)
        np.testing.assert_array_equal(times_of(times, source="a", unit="s"), times)
    assert unit_change(np.zeros(9)) is None and unit_change(-SECONDS[::-1]) is None


def write_tum(path, stamps):
    path.write_text("".join(f"{t:.9f} {i} 0 0 0 0 0 1\n" for i, t in enumerate(stamps)))
    return path


def folder_of_scans(folder, scans):
    folder.mkdir()
    for i in range(scans):
        np.zeros((3, 4), "<f4").tofile(folder / f"{i:03d}.bin")
    return folder


def test_every_file_of_times_follows_the_rule(tmp_path):
    rows, table = tmp_path / "times.txt", tmp_path / "poses.csv"
    for unit in UNITS:
        stamps = SECONDS * PER_SECOND[unit]
        np.savetxt(rows, stamps)
        np.savetxt(table, np.stack([stamps, *np.zeros((3, 280))], 1), header="t,x,y,z", comments="", delimiter=",")
        tum = write_tum(tmp_path / "poses.tum", stamps)
        for read in (read_times, read_tum, read_trajectory):
            with pytest.raises(ValueError, match="expected times in seconds, found steps"):
                read(rows if read is read_times else tum)
        with pytest.raises(ValueError, match=r"poses\.csv: expected times in seconds, found steps"):
            read_trajectory(table)
        np.testing.assert_allclose(read_times(rows, unit=unit), SECONDS)
        np.testing.assert_allclose(read_tum(tum, time_unit=unit)[1], SECONDS)
        np.testing.assert_allclose(read_trajectory(table, time_unit=unit).times, SECONDS)
        np.testing.assert_allclose(read_trajectory(table, times=rows, time_unit=unit).times, SECONDS)
    np.savetxt(rows, np.arange(280))
    with pytest.warns(DataWarning, match=r"times\.txt: expected times, found row numbers .*not used; state the unit"):
        assert read_times(rows) is None
    assert read_tum(write_tum(tmp_path / "poses.tum", range(280)))[1] is None


def test_a_change_of_the_clock_is_told_for_every_layout(tmp_path):
    folder = folder_of_scans(tmp_path / "scans", 12)
    np.savetxt(folder / "times.txt", SECONDS[:12] + 86400.0 * (np.arange(12) >= 7))
    said = r"scans: expected one drive, found 24 h between scans 6 and 7 \(1 jumps\); scans before and after a jump"
    with pytest.warns(DataWarning, match=said):
        open_recording(folder, sensor_height=1.7)
    check_jumps(np.array([0.0, 600.0, 1200.0]), source="stops")
