"""Times of scans and poses: checks of their unit and order, and of row numbers in place of times."""

import datetime
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from sglpr_jax.data.choices import TimeUnit
from sglpr_jax.fields import value_or_type
from sglpr_jax.files import warn

PER_SECOND = {"auto": 1.0, "s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Ticks of each unit in a second. "auto" expects seconds."""
NAMES = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
LATEST_S = 1e11
"""Maximum time in seconds, after the year 5000. Larger numbers are milli-, micro- or nanoseconds."""
LONGEST_STEP_S = 10.0
"""Maximum median step of scans and poses, in seconds: keyframes at 0.1 Hz."""
FACTORS = (1e3, 1e6, 1e9)
"""Ratios of two units."""
SAME_FACTOR = 3.0
"""Maximum ratio between one of `FACTORS` and the factor by which times or steps grow, if the unit changes."""
MIN_TIMES = 5
"""Number of times above which the unit is checked."""
EPOCH = 1e8
"""Number below which whole numbers may be frame numbers. Seconds since 1970 are above it since 1973."""
PAUSE_S = 3600.0
"""Minimum step that is reported as a jump of the times, in seconds."""
ADVICE = "state the unit with --time-unit s, ms, us or ns (Python: time_unit)"


def times_of(
    values: Float[np.ndarray, " n"], *, source: Path | str, unit: TimeUnit = "auto"
) -> Float[np.ndarray, " n"] | None:
    """Convert times of a file `source` to seconds. The unit "auto" expects seconds and returns None for row numbers.

    Raises ValueError if `check_order` rejects the times, or if their steps cannot be seconds and the unit is "auto".
    """
    seconds = values / PER_SECOND[unit]
    check_order(seconds, source=source)
    if unit != "auto":
        return seconds
    if counts_rows(seconds):
        return None
    if problem := time_unit_problem(seconds):
        raise ValueError(f"{source}: expected times in seconds, found {problem}; {ADVICE}")
    return seconds


def time_unit_problem(times: Float[np.ndarray, " n"], *, numbers: bool = True) -> str:
    """Describe why times cannot be seconds of scans or poses. Empty if they can, or if there are too few to decide.

    With `numbers`, whole numbers with steps of 1 or more are taken for frame numbers, which are not seconds.
    """
    if change := unit_change(times):
        _, description = change
        return description
    if len(times) and abs(times[-1]) > LATEST_S:
        return f"{times[-1]:g}, after the year 5000"
    if len(times) <= MIN_TIMES:
        return ""
    if counts_rows(times):
        return f"row numbers ({times[0]:g}, {times[1]:g}, {times[2]:g}, ...)"
    step = usual_step(times)
    if step > LONGEST_STEP_S:
        unit = next((unit for unit in NAMES if step <= LONGEST_STEP_S * PER_SECOND[unit]), "ns")
        return f"steps of {step:g}, which fit {NAMES[unit]}"
    if numbers and step >= 1 and times[0] < EPOCH and (times == np.round(times)).all():
        return f"whole numbers from {times[0]:g} to {times[-1]:g}, as of frames"
    return ""


def usual_step(times: Float[np.ndarray, " n"]) -> float:
    """Median of the positive steps between consecutive times, or 0."""
    steps = np.diff(times)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def unit_change(times: Float[np.ndarray, " n"]) -> tuple[int, str] | None:
    """Return the row from which times and steps are about 1e3, 1e6 or 1e9 times as large, with a description, or None.

    If only the times or only the steps grow, as after a pause, None is returned, and so it is with fewer than two steps
    before or after the row.
    """
    previous = np.where(times[:-1] > 0, times[:-1], np.inf)
    if not len(previous):
        return None
    row = int(np.argmax(times[1:] / previous)) + 1
    if min(np.count_nonzero(np.diff(times[:row]) > 0), np.count_nonzero(np.diff(times[row:]) > 0)) < 2:
        return None
    growth = np.array([times[row] / previous[row - 1], usual_step(times[row:]) / usual_step(times[:row])])
    for factor in FACTORS:
        if (growth > factor / SAME_FACTOR).all() and (growth < factor * SAME_FACTOR).all():
            return row, f"{times[row]:g} after {times[row - 1]:g}, and steps about {factor:g} times as large"
    return None


def counts_rows(times: Float[np.ndarray, " n"]) -> bool:
    """Whether times merely count the rows: 0, 1, 2, ... or 1, 2, 3, ..."""
    return bool(len(times) and times[0] in (0, 1) and (np.diff(times) == 1).all())


def check_order(times: Float[np.ndarray, " n"], *, source: Path | str) -> None:
    """Raise ValueError if times decrease, change their unit or exceed `LATEST_S`."""
    check_unit(times, source=source)
    late = np.flatnonzero(np.abs(times) > LATEST_S)
    if late.size:
        raise ValueError(
            f"{source}, row {late[0] + 1}: expected seconds, found {times[late[0]]:g}; is it in a smaller unit? "
            f"{ADVICE[0].upper()}{ADVICE[1:]}"
        )
    drops = np.flatnonzero(np.diff(times) < 0)
    if drops.size:
        row = int(drops[0]) + 1
        raise ValueError(f"{source}, row {row + 1}: expected a time >= {times[row - 1]}, found {times[row]}")


def check_unit(times: Float[np.ndarray, " n"], *, source: Path | str) -> None:
    """Raise ValueError if the unit of times changes between two rows (`unit_change`)."""
    if change := unit_change(times):
        raise ValueError(f"{source}, row {change[0] + 1}: expected times in one unit, found {change[1]}")


def check_jumps(times: Float[np.ndarray, " n"], *, source: str) -> None:
    """Issue a `DataWarning` if two consecutive times of a recording are over an hour apart, as with a changed clock."""
    steps = np.diff(times)
    jumps = np.flatnonzero(steps > PAUSE_S)
    if jumps.size:
        row = int(jumps[0])
        warn(
            f"{source}: expected one drive, found {steps[row] / 3600:.3g} h between scans {row} and {row + 1} "
            f"({jumps.size} jumps); scans before and after a jump count as separate visits of a place"
        )


def nearest_rows(stamps: Num[np.ndarray, " n"], times: Num[np.ndarray, " q"]) -> Int[np.ndarray, " q"]:
    """Return the row of the nearest of the ordered `stamps` for each of `times`. Ties go to the earlier one."""
    later = np.searchsorted(stamps, times).clip(0, len(stamps) - 1)
    earlier = (later - 1).clip(0)
    return np.where(np.abs(times - stamps[earlier]) <= np.abs(stamps[later] - times), earlier, later)


def as_seconds(time: Any) -> float | None:
    """Convert a date or a duration to seconds, and any other time to a number. Returns None for None."""
    if time is None:
        return None
    if isinstance(time, datetime.datetime):
        time = time.astimezone(datetime.UTC).timestamp()
    elif isinstance(time, datetime.timedelta):
        time = time.total_seconds()
    elif isinstance(time, np.datetime64):
        time = time - np.datetime64(0, "s")
    try:
        seconds = float(time / np.timedelta64(1, "s") if isinstance(time, np.timedelta64) else time)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected a time in seconds, found {value_or_type(time)}") from error
    if not np.isfinite(seconds):
        raise ValueError(f"expected a time in seconds, found {seconds}")
    return seconds
