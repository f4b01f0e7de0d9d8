"""Detects the record format of headerless scans: the format with which the files look like scans.

A wrong record format mixes the columns of a file. Then the coordinates are no longer metres, or the rows differ
periodically. If float32x6 is read as float32x4, for example, only every third row begins with x. A format therefore
fits if

- nearly all coordinates are finite and within 300 m, half of the points are within 120 m, and few coordinates are
  almost 0;
- for periods of 5 to 8 rows (which include periods of 2 to 4), the rows of each phase have similar distributions of
  directions and distances.

If two formats fit and one record is a multiple of the other, the larger one combines several points. The smaller one is
used.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeGuard, get_args

import numpy as np
from jaxtyping import Float, Float32, Int32

from sglpr_jax.data.choices import RecordFormat
from sglpr_jax.data.formats.cloud_text import check_points
from sglpr_jax.data.point_times import TimeField
from sglpr_jax.data.warning import warn
from sglpr_jax.files import in_short, naming

MOST_M = 300.0
"""Maximum absolute coordinate in metres, for all points but a fraction of `STRANGE`."""
USUAL_M = 120.0
"""Maximum median of the horizontal distance, in metres."""
LEAST_M = 1e-20
"""Minimum nonzero coordinate in metres. Smaller ones are not measurements but the low half of a wider number."""
STRANGE = 0.02
"""Maximum fraction of points that violate a limit."""
TURNS = (5, 6, 7, 8)
"""Periods of rows that are compared."""
DIRECTIONS_APART = 0.12
"""Maximum difference of the distributions of directions between phases (Kolmogorov-Smirnov statistic)."""
TIMES_AS_FAR = 8.0
"""Maximum ratio of the median distances between phases."""
SCALED_M = 1.0
"""Clouds whose coordinates are all within this limit are considered scaled, not in metres."""
FEWEST = 200
"""Minimum number of points, over all files, for the detection."""
MOST = 20_000
"""Maximum number of points that are read per file."""
FILES = 5
"""Maximum number of files that are read."""
CANDIDATES: tuple[RecordFormat, ...] = tuple(
    name for name in get_args(RecordFormat) if name not in ("nuscenes", "nclt", "float32x4")
)
"""Formats that are tried. kitti covers float32x4, and float32x5 covers nuscenes. nclt would fit almost any file."""


def find_record(paths: Sequence[Path]) -> tuple[RecordFormat | None, str]:
    """Detect the format of headerless scans from a few files, spread over the recording.

    Empty and unreadable files are ignored. Fewer than half of the files may be broken.

    Returns:
      The format, or None if there are too few points; and a description of how it was detected.

    Raises:
      ValueError: If no format fits, or several do. The message lists all formats that were tried.
    """
    chosen = _some(paths)
    if sum(path.stat().st_size for path in chosen) < FEWEST * record_type("kitti").itemsize:
        return None, "too few points to detect it"
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
        f"{paths[0] if len(paths) == 1 else paths[0].parent}: expected scans that fit exactly one format, found"
        f" {len(simplest)}; pass --format {wanted}, or nuscenes or nclt ({tried})"
    )


def record_of_scan(path: Path) -> RecordFormat:
    """Detect the format of one headerless scan: KITTI's if the scan fits it or has too few points, or else another.

    Raises ValueError if no format fits, or several others do, like `find_record`.
    """
    chosen = _some([path])
    if not chosen or not strangeness(chosen, "kitti"):
        return "kitti"
    return find_record(chosen)[0] or "kitti"


def unusual_record(paths: Sequence[Path], *, usual: RecordFormat = "kitti") -> RecordFormat | None:
    """Detect scans whose format differs from the usual one of their dataset layout.

    Users put their own recordings into the layout of a known dataset. If their points have another record size, they
    would be read incorrectly.

    Returns:
      The detected format, or None if the scans fit `usual` or no single format is detected.
    """
    chosen = _some(paths)
    if not chosen or not strangeness(chosen, usual):
        return None
    try:
        return find_record(paths)[0]
    except ValueError:
        return None


def check_record(paths: Sequence[Path], format: RecordFormat) -> None:
    """Warn if the files do not look like scans in the given format."""
    chosen = _some(paths)
    if sum(path.stat().st_size for path in chosen) < FEWEST * record_type(format).itemsize:
        return
    if strange := strangeness(chosen, format):
        warn(f"{paths[0].parent}: expected scans of {described(format)}, found {strange}")


def _some(paths: Sequence[Path]) -> list[Path]:
    """A few files, spread over the recording, without empty and unreadable ones. A crash leaves the last file empty."""
    chosen = (paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, FILES).astype(int)))
    return [path for path in chosen if _has_bytes(path)]


def _has_bytes(path: Path) -> bool:
    """Whether the file can be read and is not empty. False for dangling links and missing permissions."""
    try:
        with path.open("rb") as stream:
            return bool(stream.read(1))
    except OSError:
        return False


def strangeness(paths: Sequence[Path], format: RecordFormat) -> str:
    """Return "" if most files look like scans in this format, or else a description of the difference."""
    clouds, reasons = [], []
    for path in paths:
        points, reason = _coordinates(path, format)
        clouds += [] if reason else [points]
        reasons += [reason] if reason else []
    if len(reasons) >= len(paths) / 2:
        return max(set(reasons), key=reasons.count)
    return _strange_turns(clouds)


def _coordinates(path: Path, format: RecordFormat) -> tuple[Float[np.ndarray, "n 3"], str]:
    """The first points of a file, NaN if there was no return; and a description of invalid coordinates."""
    nothing, width = np.zeros((0, 3)), record_type(format).itemsize
    try:
        if path.stat().st_size % width:
            return nothing, f"a size that is not a multiple of {width} bytes"
        with np.errstate(invalid="ignore"):
            points = read_records(path, format).points[:MOST].astype(np.float64)
    except (OSError, ValueError) as error:  # a disk error, or a file that is being written
        return nothing, f"an unreadable file ({in_short(error)})"
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
        f"with a nonzero coordinate below {LEAST_M:g} m": ((size < LEAST_M) & (size > 0)).any(axis=1),
        "1 m away, like normals": np.abs(np.linalg.norm(np.where(size < 2, size, 9), axis=1) - 1) < 1e-4,
    }
    for what, where in shares.items():
        if where.mean() > STRANGE:
            return f"{where.mean():.0%} of the points {what}"
    if np.median(np.hypot(*size[finite, :2].T)) > USUAL_M:
        return f"half of the points beyond {USUAL_M:g} m"
    if size[finite].max() <= SCALED_M:
        return f"all points within {SCALED_M:g} m, as in scaled clouds"
    flat = [axis for axis, spread in zip("xy", np.ptp(points[finite, :2], axis=0), strict=True) if spread < 0.1]
    return f"all points with the same {flat[0]}" if flat else ""


def _strange_turns(clouds: Sequence[Float[np.ndarray, "_ 3"]]) -> str:
    direction = [np.arctan2(points[:, 1], points[:, 0]) for points in clouds]
    to_axis = [np.arctan2(np.abs(points[:, 1]), np.abs(points[:, 0])) for points in clouds]
    distance = [np.hypot(points[:, 0], points[:, 1]) for points in clouds]
    for turn in TURNS:
        values = (direction, to_axis, distance)
        looks, turned, far = ([_each(value, start, turn) for start in range(turn)] for value in values)
        fewest = min(map(len, looks))
        if fewest < FEWEST / 2 / turn:
            return f"every {turn}th point missing"
        apart = max(_apart(angles[0], other) for angles in (looks, turned) for other in angles[1:])
        if apart > DIRECTIONS_APART + 1.6 * np.sqrt(2 / fewest):
            return f"every {turn}th point in another direction"
        usual = [np.median(values) for values in far]
        if max(usual) > TIMES_AS_FAR * min(usual):
            return f"every {turn}th point at another distance"
    return ""


def _each(values: Sequence[Float[np.ndarray, "_"]], start: int, turn: int) -> Float[np.ndarray, "_"]:
    """Every `turn`-th value of each file, beginning with `start`, without NaN."""
    found = np.concatenate([each[start::turn] for each in values])
    return found[~np.isnan(found)]


def _apart(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"]) -> float:
    """Maximum difference of two empirical distribution functions."""
    a, b = np.sort(a), np.sort(b)
    both = np.concatenate([a, b])  # both halves are sorted, which makes searchsorted fast
    a_below, b_below = (np.searchsorted(x, both, side="right") / len(x) for x in (a, b))
    return float(np.abs(a_below - b_below).max())


def _repeats(name: RecordFormat, other: RecordFormat) -> bool:
    """Whether a record consists of several records of `other`."""
    this, smaller = record_type(name), record_type(other)
    same = this["xyz"].base == smaller["xyz"].base
    return same and this.itemsize % smaller.itemsize == 0


NCLT_RECORD = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
NCLT_UNIT_M = 0.005
NCLT_OFFSET_M = -100.0
"""Scale and offset of NCLT's integers: metres = value * unit + offset."""
Z_UP_FROM_Z_DOWN = np.array([1.0, -1.0, -1.0])
"""Rotation by 180 degrees about x: from forward, right, down to forward, left, up. Negating only z would mirror
scans."""


class Records(NamedTuple):
    """Points of one scan, with their lasers and times."""

    points: Float32[np.ndarray, "n 3"]
    """Points in metres: x forward, y left, z up if the format defines its axes, or else the axes of the file."""
    lasers: Int32[np.ndarray, " n"] | None
    """Laser number of each point, or None if the format has none."""
    times: TimeField | None = None
    """Field with the times of the points, or None if the format has none."""


def is_record(format: str) -> TypeGuard[RecordFormat]:
    """Whether scans of this format are records without a header."""
    return format in get_args(RecordFormat)


def record_type(format: RecordFormat) -> np.dtype:
    """Return the numpy type of one point. The field "xyz" comes first."""
    if format == "nclt":
        return NCLT_RECORD
    if format == "nuscenes":
        return np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("laser", "<f4")])
    number, columns = ("float32", "4") if format == "kitti" else format.split("x")
    letter = {"float32": "<f4", "float64": "<f8"}[number]
    more = int(columns) - 3
    return np.dtype([("xyz", letter, 3), *([("more", letter, more)] if more else [])])


def described(format: RecordFormat) -> str:
    """Return a description of a format: "float32x6 (24 bytes a point)"."""
    return f"{format} ({record_type(format).itemsize} bytes a point)"


def read_records(path: Path, format: RecordFormat, *, last_is_time: bool = False) -> Records:
    """Read a file of records.

    Arguments:
      path: The file.
      format: Format of one point.
      last_is_time: Whether the last of the columns after x, y, z is the time of the point.

    Raises:
      ValueError: If the file is empty or too large, or its size is not a multiple of the record size.

    Example:
      points = read_records(path, "float32x6").points
    """
    dtype = record_type(format)
    size = path.stat().st_size
    if size == 0 or size % dtype.itemsize:
        others = ", ".join(f"{name} has {record_type(name).itemsize}" for name in ("kitti", "nuscenes", "nclt"))
        raise ValueError(
            f"{path}: expected {dtype.itemsize} bytes for each point ({format}), found {size} bytes in total; the file"
            f" is truncated, or has another format ({others} bytes a point; pcd has a header)"
        )
    with naming(path):
        check_points(size // dtype.itemsize, bytes_each=dtype.itemsize)
    records = np.fromfile(path, dtype=dtype)
    times = TimeField("time", records["more"][:, -1].copy()) if last_is_time else None
    lasers = records["laser"].astype(np.int32) if "laser" in (dtype.names or ()) else None
    with np.errstate(over="ignore", invalid="ignore"):  # invalid numbers are dropped by the callers
        # Column-major order: the copy takes half the time, and later steps work along the axes.
        return Records(np.asfortranarray(_our_axes(records["xyz"], format), dtype=np.float32), lasers, times)


def _our_axes(xyz: np.ndarray, format: RecordFormat) -> np.ndarray:
    """Convert the coordinates of a format to metres, x forward, y left, z up."""
    if format == "nuscenes":
        return np.stack([xyz[:, 1], -xyz[:, 0], xyz[:, 2]], axis=1)
    if format == "nclt":
        return (xyz.astype(np.float64) * NCLT_UNIT_M + NCLT_OFFSET_M) * Z_UP_FROM_Z_DOWN
    return xyz
