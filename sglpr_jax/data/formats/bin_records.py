"""Reads scans without a header (.bin), and detects their format.

A wrong format mixes the columns of a file. A format fits if the sizes of most files are multiples of its record, if
nearly all coordinates are plausible, and if the rows do not differ periodically. If a file of float32x6 is read as
float32x4, for example, only every third row begins with x. If several formats fit, the user has to name one.
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TypeGuard, get_args

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import RecordFormat
from sglpr_jax.data.formats.clouds import check_points
from sglpr_jax.data.scan import Scan, TimeField
from sglpr_jax.data.warning import warn
from sglpr_jax.files import naming

MOST_M = 300.0
"""Maximum absolute coordinate in metres, for all points but a fraction of `STRANGE`."""
USUAL_M = 120.0
"""Maximum median of the horizontal distance, in metres."""
LEAST_M = 1e-20
"""Minimum nonzero coordinate in metres. Smaller ones are not measurements but the low half of a wider number."""
STRANGE = 0.02
"""Maximum fraction of points that violate a limit."""
PERIODS = (5, 6, 7, 8)
"""Periods of rows that are compared. They include periods of 2 to 4."""
DIRECTIONS_APART = 0.12
"""Maximum difference of the distributions of directions between rows of a period (Kolmogorov-Smirnov statistic)."""
TIMES_AS_FAR = 8.0
"""Maximum ratio of the median distances between rows of a period."""
SCALED_M = 1.0
"""Clouds whose coordinates are all within this limit are considered scaled, not in metres."""
FEWEST, MOST = 200, 20_000
"""Minimum number of points over all files, and maximum number of points that are read per file."""
FILES = 5
"""Maximum number of files that are read."""
CANDIDATES: tuple[RecordFormat, ...] = tuple(
    name for name in get_args(RecordFormat) if name not in ("nuscenes", "nclt", "float32x4")
)
"""Formats that are tried. kitti covers float32x4, and float32x5 covers nuscenes. nclt would fit almost any file."""
NCLT_RECORD = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
NCLT_UNIT_M = 0.005
NCLT_OFFSET_M = -100.0
"""Scale and offset of NCLT's integers: metres = value * unit + offset."""
Z_UP_FROM_Z_DOWN = np.array([1.0, -1.0, -1.0])
"""Rotation by 180 degrees about x: from forward, right, down to forward, left, up. Negating only z would mirror
scans."""


def detect_point_format(paths: Sequence[Path]) -> tuple[RecordFormat | None, str]:
    """Detect the format of headerless scans from a few files, and return it with a description of how it was detected.

    Fewer than half of the files may be broken. A format whose record consists of several records of another one that
    fits does not count. With too few points, it returns None. Raises ValueError if no format fits, or several do.
    """
    chosen = _some(paths)
    if not _enough(chosen, "kitti"):
        return None, "too few points to detect it"
    misfits: dict[RecordFormat, str] = {name: _misfit(chosen, name) for name in CANDIDATES}
    fits: list[RecordFormat] = [name for name in CANDIDATES if not misfits[name]]
    simplest: list[RecordFormat] = [
        name for name in fits if not any(_repeats(name, other) for other in fits if other != name)
    ]
    if len(simplest) == 1:
        return simplest[0], f"found from {len(chosen)} of {len(paths)} scans"
    tried = "; ".join(f"{described(name)}: {misfits[name] or 'fits'}" for name in CANDIDATES)
    raise ValueError(
        f"{paths[0] if len(paths) == 1 else paths[0].parent}: expected scans that fit exactly one format, found"
        f" {len(simplest)}; pass --format {' or '.join(simplest) or 'one of these'}, or nuscenes or nclt ({tried})"
    )


def record_of_scan(path: Path) -> RecordFormat:
    """Detect the format of one headerless scan: KITTI's if the scan fits it or has too few points, or else another."""
    return "kitti" if _fits_kitti([path]) else detect_point_format([path])[0] or "kitti"


def unusual_record(paths: Sequence[Path]) -> RecordFormat | None:
    """Return the format of scans in KITTI's layout if it is clearly another one, as of users' own scans."""
    with contextlib.suppress(ValueError):
        return None if _fits_kitti(paths) else detect_point_format(paths)[0]
    return None


def _fits_kitti(paths: Sequence[Path]) -> bool:
    """Whether the files look like scans in KITTI's format, or tell nothing."""
    chosen = _some(paths)
    return not chosen or not _misfit(chosen, "kitti")


def check_record(paths: Sequence[Path], format: RecordFormat) -> None:
    """Warn if the files have enough points and do not look like scans in the given format."""
    chosen = _some(paths)
    if _enough(chosen, format) and (misfit := _misfit(chosen, format)):
        warn(f"{paths[0].parent}: expected scans of {described(format)}, found {misfit}")


def _enough(paths: Sequence[Path], format: RecordFormat) -> bool:
    return sum(path.stat().st_size for path in paths) >= FEWEST * record_type(format).itemsize


def _some(paths: Sequence[Path]) -> list[Path]:
    """A few files, spread over the recording, without empty and unreadable ones. A crash leaves the last file empty."""
    chosen = (paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, FILES).astype(int)))
    return [path for path in chosen if path.is_file() and path.stat().st_size]


def _misfit(paths: Sequence[Path], format: RecordFormat) -> str:
    """Why most files do not look like scans in this format, or ""."""
    width, clouds, reasons = record_type(format).itemsize, [], []
    for path in paths:
        try:
            with np.errstate(invalid="ignore"):  # of numbers of another type
                points = read_records(path, format).cloud[:MOST].astype(np.float64)
        except (OSError, ValueError):
            reasons.append(f"a size that is not a multiple of {width} bytes, or an unreadable file")
            continue
        points[np.isnan(points).all(axis=1) | (points == 0).all(axis=1)] = np.nan
        reason = _implausible(points[~np.isnan(points).all(axis=1)])
        reasons += [reason] if reason else []
        clouds += [] if reason else [points]
    if 2 * len(reasons) >= len(paths):
        return max(set(reasons), key=reasons.count)
    return next((reason for period in PERIODS if (reason := _periodic(clouds, period))), "")


def _implausible(points: Float[np.ndarray, "n 3"]) -> str:
    """Why points cannot be those of a scan in metres, or ""."""
    if not len(points):
        return "all points NaN or 0"
    size = np.abs(points)
    wrong = ~((size <= MOST_M) & ((size >= LEAST_M) | (size == 0))).all(axis=1)  # True for NaN
    if wrong.mean() > STRANGE:
        return f"{wrong.mean():.0%} of the points not finite or beyond {MOST_M:g} m"
    points, size = points[~wrong], size[~wrong]
    if (np.abs(np.linalg.norm(points, axis=1) - 1) < 1e-4).mean() > STRANGE:
        return "points 1 m away, like normals"
    if np.median(np.hypot(*points[:, :2].T)) > USUAL_M:
        return f"half of the points beyond {USUAL_M:g} m"
    if size.max() <= SCALED_M:
        return f"all points within {SCALED_M:g} m, as in scaled clouds"
    return "all points with the same x or y" if np.ptp(points[:, :2], axis=0).min() < 0.1 else ""


def _periodic(clouds: Sequence[Float[np.ndarray, "_ 3"]], period: int) -> str:
    """Why every `period`-th row differs from the others, or ""."""
    rows = [np.concatenate([points[start::period] for points in clouds]) for start in range(period)]
    x, y = zip(*(points[~np.isnan(points).any(axis=1), :2].T for points in rows), strict=True)
    fewest = min(map(len, x))
    if fewest < FEWEST / 2 / period:
        return f"every {period}th point missing"
    apart = DIRECTIONS_APART + 1.6 * np.sqrt(2 / fewest)
    for angles in (list(map(np.arctan2, y, x)), [np.arctan2(np.abs(b), np.abs(a)) for a, b in zip(x, y, strict=True)]):
        if max(_apart(angles[0], other) for other in angles[1:]) > apart:
            return f"every {period}th point in another direction"
    usual = [np.median(np.hypot(a, b)) for a, b in zip(x, y, strict=True)]
    return f"every {period}th point at another distance" if max(usual) > TIMES_AS_FAR * min(usual) else ""


def _apart(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"]) -> float:
    """Maximum difference of two empirical distribution functions."""
    a, b = np.sort(a), np.sort(b)
    both = np.concatenate([a, b])  # both halves are sorted, which makes searchsorted fast
    a_below, b_below = (np.searchsorted(x, both, side="right") / len(x) for x in (a, b))
    return float(np.abs(a_below - b_below).max())


def _repeats(name: RecordFormat, other: RecordFormat) -> bool:
    """Whether a record consists of several records of `other`."""
    this, smaller = record_type(name), record_type(other)
    return this["xyz"].base == smaller["xyz"].base and this.itemsize % smaller.itemsize == 0


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


def read_records(path: Path, format: RecordFormat, *, last_is_time: bool = False) -> Scan:
    """Read a file of records. With `last_is_time`, the last column is the time of the point."""
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
    xyz = records["xyz"]
    with np.errstate(over="ignore", invalid="ignore"):  # invalid numbers are dropped by the callers
        if format == "nuscenes":
            xyz = np.stack([xyz[:, 1], -xyz[:, 0], xyz[:, 2]], axis=1)
        elif format == "nclt":
            xyz = (xyz.astype(np.float64) * NCLT_UNIT_M + NCLT_OFFSET_M) * Z_UP_FROM_Z_DOWN
        # Column-major order: the copy takes half the time, and later steps work along the axes.
        return Scan(points=np.asfortranarray(xyz, dtype=np.float32), lasers=lasers, time_field=times)
