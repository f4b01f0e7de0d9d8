"""Reads scans without a header (.bin), and detects their format.

A wrong format mixes the columns of a file. A format fits if the sizes of most files are multiples of its record, if
nearly all coordinates are plausible, and if the rows do not differ periodically. If a file of float32x6 is read as
float32x4, for example, only every third row begins with x. If several formats fit, the user has to name one.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeGuard, get_args

import numpy as np
from jaxtyping import Float, Num

from sglpr_jax.data.choices import RecordFormat
from sglpr_jax.data.formats.clouds import check_points
from sglpr_jax.data.scan import Scan, TimeField, time_field_of
from sglpr_jax.files import naming, warn

NCLT_RECORD = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
NCLT_UNIT_M = 0.005
NCLT_OFFSET_M = -100.0
"""Scale and offset of NCLT's integers: metres = value * unit + offset."""
Z_UP_FROM_Z_DOWN = np.array([1.0, -1.0, -1.0])
"""Rotation by 180 degrees about x: from forward, right, down to forward, left, up. Negating only z would mirror
scans."""
AXES: dict[str, Callable[[Num[np.ndarray, "n 3"]], Num[np.ndarray, "n 3"]]] = {
    "nuscenes": lambda xyz: np.stack([xyz[:, 1], -xyz[:, 0], xyz[:, 2]], axis=1),
    "nclt": lambda xyz: (xyz.astype(np.float64) * NCLT_UNIT_M + NCLT_OFFSET_M) * Z_UP_FROM_Z_DOWN,
}
"""Functions that convert the numbers of a format to metres, x forward, y left, z up."""


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
    kind = {"float32": "<f4", "float64": "<f8"}[number]
    return np.dtype([("xyz", kind, 3), ("more", kind, (int(columns) - 3,))])


def describe_format(format: str) -> str:
    """Return a description of a format: "float32x6 (24 bytes a point)", or "pcd"."""
    return f"{format} ({record_type(format).itemsize} bytes a point)" if is_record(format) else format


def read_records(path: Path, format: RecordFormat) -> Scan:
    """Read a scan in one of the formats without a header."""
    return read_record_file(path, record_type(format), format=format)


def read_record_file(path: Path, record: np.dtype, *, format: str) -> Scan:
    """Read a scan of packed records, with the laser numbers and times of its points if the record has them.

    Arguments:
      path: File of the scan.
      record: Numpy type of one point: "xyz", and perhaps "laser" or "line" and a field of `TIME_FIELDS`.
      format: Name of the format, for messages and `AXES`.
    """
    size = path.stat().st_size
    if size == 0 or size % record.itemsize:
        others = ", ".join(f"{name} has {record_type(name).itemsize}" for name in ("kitti", "nuscenes", "nclt"))
        raise ValueError(
            f"{path}: expected {record.itemsize} bytes for each point ({format}), found {size} bytes in total; the file"
            f" is truncated, or has another format ({others} bytes a point; pcd has a header)"
        )
    with naming(path):
        check_points(size // record.itemsize, bytes_each=record.itemsize)
    records, names = np.fromfile(path, dtype=record), record.names or ()
    laser = next((name for name in ("laser", "line") if name in names), None)
    time = time_field_of(names)
    with np.errstate(over="ignore", invalid="ignore"):  # invalid numbers are dropped by the callers
        xyz = AXES.get(format, lambda xyz: xyz)(records["xyz"])
        return Scan(
            # Column-major order: the copy takes half the time, and later steps work along the axes.
            points=np.asfortranarray(xyz, dtype=np.float32),
            lasers=None if laser is None else records[laser].astype(np.int32),
            time_field=None if time is None else TimeField(time, records[time].copy()),
        )


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
HALF_RECORDS = {"float32x6": "float32x3", "float32x8": "kitti", "float64x6": "float64x3"}
"""Formats whose record consists of two records of another format. If both fit, only the other one counts."""


def detect_point_format(paths: Sequence[Path]) -> tuple[RecordFormat | None, str]:
    """Detect the format of headerless scans from a few files, and return it with a description of how it was detected.

    Fewer than half of the files may be broken. With too few points, returns None as the format. Raises ValueError if no
    format fits, or several do.
    """
    samples = _samples(paths)
    if not _has_enough(samples, "kitti"):
        return None, "too few points to detect it"
    misfits: dict[RecordFormat, str] = {name: _misfit(samples, name) for name in CANDIDATES}
    fits: list[RecordFormat] = [name for name in CANDIDATES if not misfits[name]]
    simplest: list[RecordFormat] = [name for name in fits if HALF_RECORDS.get(name) not in fits]
    if len(simplest) == 1:
        return simplest[0], f"found from {len(samples)} of {len(paths)} scans"
    tried = "; ".join(f"{describe_format(name)}: {misfits[name] or 'fits'}" for name in CANDIDATES)
    raise ValueError(
        f"{paths[0] if len(paths) == 1 else paths[0].parent}: expected scans that fit exactly one format, found"
        f" {len(simplest)}; pass --format {' or '.join(simplest) or 'one of these'}, or nuscenes or nclt ({tried})"
    )


def unusual_record(paths: Sequence[Path]) -> RecordFormat | None:
    """Return the format of scans that are clearly not in KITTI's, or None if they fit it or have too few points.

    Raises ValueError if they fit no format, or several others.
    """
    samples = _samples(paths)
    return detect_point_format(paths)[0] if samples and _misfit(samples, "kitti") else None


def check_record(paths: Sequence[Path], format: RecordFormat) -> None:
    """Warn if the files have enough points and do not look like scans in the given format."""
    samples = _samples(paths)
    if _has_enough(samples, format) and (misfit := _misfit(samples, format)):
        warn(f"{paths[0].parent}: expected scans of {describe_format(format)}, found {misfit}")


def _samples(paths: Sequence[Path]) -> list[Path]:
    """A few files, spread over the recording, without empty and unreadable ones. A crash leaves the last file empty."""
    spread = (paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, FILES).astype(int)))
    return [path for path in spread if path.is_file() and path.stat().st_size]


def _has_enough(paths: Sequence[Path], format: RecordFormat) -> bool:
    return sum(path.stat().st_size for path in paths) >= FEWEST * record_type(format).itemsize


def _misfit(paths: Sequence[Path], format: RecordFormat) -> str:
    """Why most files do not look like scans in this format, or ""."""
    clouds, reasons = [], []
    for path in paths:
        try:
            with np.errstate(invalid="ignore"):  # of numbers of another type
                points = read_records(path, format).cloud[:MOST].astype(np.float64)
        except (OSError, ValueError):
            width = record_type(format).itemsize
            reasons.append(f"a size that is not a multiple of {width} bytes, or an unreadable file")
            continue
        points[(points == 0).all(axis=1)] = np.nan
        if reason := _implausible(points[~np.isnan(points).all(axis=1)]):
            reasons.append(reason)
        else:
            clouds.append(points)
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
    phases = [np.concatenate([points[start::period] for points in clouds]) for start in range(period)]
    phases = [points[~np.isnan(points).any(axis=1), :2].T for points in phases]
    fewest = min(xy.shape[1] for xy in phases)
    if fewest < FEWEST / 2 / period:
        return f"every {period}th point missing"
    most = DIRECTIONS_APART + 1.6 * np.sqrt(2 / fewest)
    for fold in (np.asarray, np.abs):  # all directions, and those of one quadrant
        first, *others = (np.sort(np.arctan2(fold(y), fold(x))) for x, y in phases)
        if max(_kolmogorov_smirnov(first, other) for other in others) > most:
            return f"every {period}th point in another direction"
    distances_m = [np.median(np.hypot(x, y)) for x, y in phases]
    far_apart = max(distances_m) > TIMES_AS_FAR * min(distances_m)
    return f"every {period}th point at another distance" if far_apart else ""


def _kolmogorov_smirnov(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"]) -> float:
    """Maximum difference of the empirical distribution functions of two sorted samples."""
    values = np.concatenate([a, b])
    a_below, b_below = (np.searchsorted(x, values, side="right") / len(x) for x in (a, b))
    return float(np.abs(a_below - b_below).max())
