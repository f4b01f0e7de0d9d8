"""Finds how many numbers each point of headerless scans has: the reading under which all files look like scans.

Read with a wrong record, the columns of a file get mixed. Then coordinates are no longer metres, or the rows differ in
turn: of float32x6 read as float32x4 every third row begins with x. So a reading fits where

- nearly all coordinates are finite and within 300 m, half of them within 120 m, and few are next to nothing;
- rows of every turn (each fifth to eighth, and so each second to fourth) look into the same directions, as far.

Of two readings that fit, one with a multiple of the columns of the other is the same points in twos or threes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import RecordFormat
from sglpr_jax.data.formats.bin_records import described, read_records, record_type
from sglpr_jax.data.warning import warn
from sglpr_jax.files import in_short

MOST_M = 300.0
"""Coordinates lie within so many metres, all but a share of `STRANGE`."""
USUAL_M = 120.0
"""Half of the points are nearer than this on the ground."""
LEAST_M = 1e-20
"""Coordinates that are smaller and not 0 are no measurement but the low half of a wider number."""
STRANGE = 0.02
TURNS = (5, 6, 7, 8)
DIRECTIONS_APART = 0.12
"""The most by which the distributions of directions may differ from turn to turn (Kolmogorov-Smirnov)."""
TIMES_AS_FAR = 8.0
"""The most by which the usual distances may differ from turn to turn."""
SCALED_M = 1.0
"""A cloud within this is in no metres."""
FEWEST = 200
"""So few points, of all files together, tell nothing."""
MOST = 20_000
"""Points of a file that are looked at."""
FILES = 5
"""Files that are looked at."""
CANDIDATES: tuple[RecordFormat, ...] = tuple(
    name for name in get_args(RecordFormat) if name not in ("nuscenes", "nclt", "float32x4")
)
"""The float32x4 are kitti's; nuscenes are float32x5, and nclt fits nearly all."""


def find_record(paths: Sequence[Path]) -> tuple[RecordFormat | None, str]:
    """Return the format of headerless scans, and in words how it was found; None where they are too few to tell.

    A few of the files are looked at, all over the recording. Some may be broken, most not; what is empty or cannot be
    read tells nothing. Raises ValueError, with all that was tried, where no reading fits or more than one does.
    """
    chosen = _some(paths)
    if sum(path.stat().st_size for path in chosen) < FEWEST * record_type("kitti").itemsize:
        return None, "too few points to find out"
    strange: dict[RecordFormat, str] = {name: strangeness(chosen, name) for name in CANDIDATES}
    fits: list[RecordFormat] = [name for name in CANDIDATES if not strange[name]]
    simplest: list[RecordFormat] = [
        name for name in fits if not any(_repeats(name, other) for other in fits if other != name)
    ]
    if len(simplest) == 1:
        return simplest[0], f"found from {len(chosen)} of {len(paths)} scans"
    reasons = dict.fromkeys(strange.values())
    tried = "; ".join(
        f"{', '.join(described(name) for name in CANDIDATES if strange[name] == why)}: {why or 'fits'}"
        for why in reasons
    )
    wanted = " or ".join(simplest) if simplest else "one of these"
    raise ValueError(
        f"{paths[0].parent}: expected scans of which one reading fits, found {len(simplest)}; say --format {wanted},"
        f" or nuscenes or nclt ({tried})"
    )


def unusual_record(paths: Sequence[Path], *, usual: RecordFormat = "kitti") -> RecordFormat | None:
    """Return the format of scans that are not what their layout says; None where they are, or nothing tells.

    For own recordings that were put into the layout of a dataset: a record of another size would read as garbage.
    """
    chosen = _some(paths)
    if not chosen or not strangeness(chosen, usual):
        return None
    try:
        return find_record(paths)[0]
    except ValueError:
        return None


def check_record(paths: Sequence[Path], format: RecordFormat) -> None:
    """Warn of scans that do not look like scans when they are read as somebody said."""
    chosen = _some(paths)
    if sum(path.stat().st_size for path in chosen) < FEWEST * record_type(format).itemsize:
        return
    if strange := strangeness(chosen, format):
        warn(f"{paths[0].parent}: expected scans of {described(format)}, found that {strange}")


def _some(paths: Sequence[Path]) -> list[Path]:
    """A few files, all over the recording, without those that tell nothing: a crash leaves the last one empty."""
    chosen = (paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, FILES).astype(int)))
    return [path for path in chosen if _has_bytes(path)]


def _has_bytes(path: Path) -> bool:
    """Whether there is anything to read: not in an empty file, behind a dangling link, or without permission."""
    try:
        with path.open("rb") as stream:
            return bool(stream.read(1))
    except OSError:
        return False


def strangeness(paths: Sequence[Path], format: RecordFormat) -> str:
    """Return "" where most of these files, read so, look like scans, else what is strange about them."""
    clouds, reasons = [], []
    for path in paths:
        points, reason = _coordinates(path, format)
        clouds += [] if reason else [points]
        reasons += [reason] if reason else []
    if len(reasons) >= len(paths) / 2:
        return max(set(reasons), key=reasons.count)
    return _strange_turns(clouds)


def _coordinates(path: Path, format: RecordFormat) -> tuple[Float[np.ndarray, "n 3"], str]:
    """The first points of a file, NaN where there was no return; and what is strange about them."""
    nothing, width = np.zeros((0, 3)), record_type(format).itemsize
    try:
        if path.stat().st_size % width:
            return nothing, f"no whole number of {width} bytes"
        with np.errstate(invalid="ignore"):
            points = read_records(path, format).points[:MOST].astype(np.float64)
    except (OSError, ValueError) as error:  # a bad disk, or a file that is being written: the others may tell
        return nothing, f"not readable ({in_short(error)})"
    missing = np.isnan(points).all(axis=1) | (points == 0).all(axis=1)
    points[missing] = np.nan
    return points, _strange_range(points[~missing])


def _strange_range(points: Float[np.ndarray, "n 3"]) -> str:
    if not len(points):
        return "all points NaN or 0"
    finite, size = np.isfinite(points).all(axis=1), np.abs(points)
    shares = {
        "not finite": ~finite,
        f"beyond {MOST_M:g} m": (size > MOST_M).any(axis=1),
        f"nearer to an axis than {LEAST_M:g} m": ((size < LEAST_M) & (size > 0)).any(axis=1),
        "1 m away, as normals are": np.abs(np.linalg.norm(np.where(size < 2, size, 9), axis=1) - 1) < 1e-4,
    }
    for what, where in shares.items():
        if where.mean() > STRANGE:
            return f"{where.mean():.0%} of the points {what}"
    if np.median(np.hypot(*size[finite, :2].T)) > USUAL_M:
        return f"half of the points beyond {USUAL_M:g} m"
    if size[finite].max() <= SCALED_M:
        return f"all points within {SCALED_M:g} m, as in clouds that are scaled"
    flat = [axis for axis, spread in zip("xy", np.ptp(points[finite, :2], axis=0), strict=True) if spread < 0.1]
    return f"all points have one {flat[0]}" if flat else ""


def _strange_turns(clouds: Sequence[Float[np.ndarray, "_ 3"]]) -> str:
    direction = [np.arctan2(points[:, 1], points[:, 0]) for points in clouds]
    to_axis = [np.arctan2(np.abs(points[:, 1]), np.abs(points[:, 0])) for points in clouds]
    distance = [np.hypot(points[:, 0], points[:, 1]) for points in clouds]
    for turn in TURNS:
        values = (direction, to_axis, distance)
        looks, turned, far = ([_each(value, start, turn) for start in range(turn)] for value in values)
        fewest = min(map(len, looks))
        if fewest < FEWEST / 2 / turn:
            return f"each {turn}th point is missing"
        apart = max(_apart(angles[0], other) for angles in (looks, turned) for other in angles[1:])
        if apart > DIRECTIONS_APART + 1.6 * np.sqrt(2 / fewest):
            return f"each {turn}th point looks elsewhere"
        usual = [np.median(values) for values in far]
        if max(usual) > TIMES_AS_FAR * min(usual):
            return f"each {turn}th point is elsewhere"
    return ""


def _each(values: Sequence[Float[np.ndarray, "_"]], start: int, turn: int) -> Float[np.ndarray, "_"]:
    """Every `turn`-th value of all files from `start` on, without NaN."""
    found = np.concatenate([each[start::turn] for each in values])
    return found[~np.isnan(found)]


def _apart(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"]) -> float:
    """The largest difference of two empirical distribution functions."""
    a, b = np.sort(a), np.sort(b)
    both = np.concatenate([a, b])  # two sorted halves: a search of numbers in order takes a fraction of the time
    a_below, b_below = (np.searchsorted(x, both, side="right") / len(x) for x in (a, b))
    return float(np.abs(a_below - b_below).max())


def _repeats(name: RecordFormat, other: RecordFormat) -> bool:
    """Whether a record is several of another, number for number."""
    this, smaller = record_type(name), record_type(other)
    same = this["xyz"].base == smaller["xyz"].base
    return same and this.itemsize % smaller.itemsize == 0
