"""Reads scans without a header (.bin), and detects their format.

A headerless scan is a sequence of records, one per point. Read in a wrong format, its columns are mixed: if a file of
float32x6 is read as float32x4, only every third row begins with x. A format therefore fits if the sizes of most files
are multiples of its record, nearly all coordinates are plausible, and rows do not differ periodically. If several
formats fit, the user has to name one.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeGuard, get_args

import numpy as np
from jaxtyping import Float, Num

from sglpr_jax.data.choices import RecordFormat
from sglpr_jax.data.formats.clouds import check_points, cloud_scan
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import naming, warn

NCLT_RECORD = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
NCLT_UNIT_M = 0.005
NCLT_OFFSET_M = -100.0
"""Scale and offset of NCLT's integers: metres = value * unit + offset."""
Z_UP_FROM_Z_DOWN = np.array([1.0, -1.0, -1.0])
"""Rotation by 180 degrees about x, as factors of x, y and z: forward, right, down becomes forward, left, up."""
AXES: dict[str, Callable[[Num[np.ndarray, "n 3"]], Num[np.ndarray, "n 3"]]] = {
    "nuscenes": lambda xyz: np.stack([xyz[:, 1], -xyz[:, 0], xyz[:, 2]], axis=1),
    "nclt": lambda xyz: (xyz.astype(np.float64) * NCLT_UNIT_M + NCLT_OFFSET_M) * Z_UP_FROM_Z_DOWN,
}
"""Functions that convert the coordinates in a file of this format to metres, x forward, y left, z up."""


def is_headerless(format: str) -> TypeGuard[RecordFormat]:
    """Whether scans of this format are records without a header."""
    return format in get_args(RecordFormat)


def record_type(format: RecordFormat) -> np.dtype:
    """Return the numpy type of one point. Its first field is "xyz"."""
    if format == "nclt":
        return NCLT_RECORD
    if format == "nuscenes":
        return np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("laser", "<f4")])
    number_type, columns = ("float32", "4") if format == "kitti" else format.split("x")  # such as float64x3
    numpy_type = {"float32": "<f4", "float64": "<f8"}[number_type]
    return np.dtype([("xyz", numpy_type, 3), ("more", numpy_type, (int(columns) - 3,))])


def describe_format(format: str) -> str:
    """Return a description of a format: "float32x6 (24 bytes a point)", or "pcd"."""
    return f"{format} ({record_type(format).itemsize} bytes a point)" if is_headerless(format) else format


def read_records(path: Path, format: RecordFormat) -> Scan:
    """Read a scan in one of the formats without a header."""
    return read_record_file(path, record_type(format), format=format)


def read_record_file(path: Path, record: np.dtype, *, format: str) -> Scan:
    """Read a scan of packed records, with the laser numbers and times of its points if the record has them.

    Arguments:
      path: File of the scan.
      record: Numpy type of one point: "xyz", and perhaps a field of `LASER_FIELDS` and one of `TIME_FIELDS`.
      format: Name of the format, for messages, and for the conversion to metres if `AXES` has one for this format.
    """
    size = path.stat().st_size
    if size == 0 or size % record.itemsize:
        others = ", ".join(f"{name} has {record_type(name).itemsize}" for name in ("kitti", "nuscenes", "nclt"))
        raise ValueError(
            f"{path}: expected {record.itemsize} bytes for each point ({format}), found {size} bytes in total; the file"
            f" is truncated, or has another format ({others} bytes a point; pcd has a header)"
        )
    with naming(path):  # errors begin with the path
        check_points(size // record.itemsize, bytes_each=record.itemsize)
    points = np.fromfile(path, dtype=record)
    with np.errstate(over="ignore", invalid="ignore"):  # callers drop invalid coordinates
        xyz = AXES[format](points["xyz"]) if format in AXES else points["xyz"]
        # Column-major order: the copy takes half the time, and later steps work along the axes.
        return cloud_scan(points, points=np.asfortranarray(xyz, dtype=np.float32))


MAX_COORDINATE_M = 300.0
"""Maximum absolute coordinate in metres, for all points but a fraction of `MAX_INVALID_FRACTION`."""
MAX_MEDIAN_DISTANCE_M = 120.0
"""Maximum median of the horizontal distance, in metres."""
MIN_COORDINATE_M = 1e-20
"""Minimum nonzero coordinate in metres. Smaller ones are not measurements but the low half of a wider number."""
MAX_INVALID_FRACTION = 0.02
"""Maximum fraction of points that violate a limit."""
PERIODS = (5, 6, 7, 8)
"""Tested periods in rows. A period of 2, 3 or 4 rows is also one of 6 or 8 rows."""
MAX_DIRECTION_DIFFERENCE = 0.12
"""Maximum difference of the distributions of directions between rows of a period (Kolmogorov-Smirnov statistic)."""
MAX_DISTANCE_RATIO = 8.0
"""Maximum ratio of the median distances between rows of a period."""
MIN_AXES_DIFFERENCE = 0.1
"""Minimum difference of the distributions of x, y and z (largest Kolmogorov-Smirnov statistic of two of them). In KITTI
it is 0.49, and in a small square room 0.2. If the columns of a file follow one another, "x", "y" and "z" are samples of
one column."""
SCALED_M = 1.0
"""Clouds whose coordinates are all within this limit are considered scaled, not in metres."""
MIN_POINTS, MAX_POINTS = 200, 20_000
"""Minimum number of points over all files, and maximum number of points that are read per file."""
MAX_FILES = 5
"""Maximum number of files that are read."""
CANDIDATES: tuple[RecordFormat, ...] = tuple(
    name for name in get_args(RecordFormat) if name not in ("nuscenes", "nclt", "float32x4")
)
"""Formats that are tried. kitti covers float32x4, and float32x5 covers nuscenes. nclt would fit almost any file."""
HALF_RECORDS = {"float32x6": "float32x3", "float32x8": "kitti", "float64x6": "float64x3"}
"""For a format whose record equals two records of another format, the other format. If both fit, the other is used."""


def detect_point_format(paths: Sequence[Path]) -> tuple[RecordFormat | None, str]:
    """Detect the format of headerless scans from a few files, and return it with a description of how it was detected.

    Fewer than half of the files may be broken. With too few points, returns None as the format. Raises ValueError if no
    format fits, or several do.
    """
    samples = _sample_files(paths)
    if not _has_enough_points(samples, "kitti"):
        return None, "too few points to detect it"
    misfits: dict[RecordFormat, str] = {name: _misfit(samples, name) for name in CANDIDATES}
    fitting: list[RecordFormat] = [name for name in CANDIDATES if not misfits[name]]
    fitting = [name for name in fitting if HALF_RECORDS.get(name) not in fitting]
    if len(fitting) == 1:
        return fitting[0], f"found from {len(samples)} of {len(paths)} scans"
    tried = "; ".join(f"{describe_format(name)}: {misfits[name] or 'fits'}" for name in CANDIDATES)
    raise ValueError(
        f"{paths[0] if len(paths) == 1 else paths[0].parent}: expected scans that fit exactly one format, found"
        f" {len(fitting)}; pass --format {' or '.join(fitting) or 'one of these'}, or nuscenes or nclt ({tried})"
    )


def detect_format_unless_kitti(paths: Sequence[Path]) -> RecordFormat | None:
    """Return the format of headerless scans that do not fit KITTI's, or None if they fit it or have too few points.

    Raises ValueError if they fit no format, or several formats other than KITTI's (`detect_point_format`).
    """
    samples = _sample_files(paths)
    return detect_point_format(paths)[0] if samples and _misfit(samples, "kitti") else None


def warn_of_other_format(paths: Sequence[Path], format: RecordFormat) -> None:
    """Warn if the files have enough points to judge and do not look like scans in the given format."""
    samples = _sample_files(paths)
    if _has_enough_points(samples, format) and (misfit := _misfit(samples, format)):
        where = paths[0] if len(paths) == 1 else paths[0].parent
        warn(f"{where}: expected scans of {describe_format(format)}, found {misfit}")


def _sample_files(paths: Sequence[Path]) -> list[Path]:
    """Return a few files spread over the recording, without missing and empty ones. A crash leaves an empty file."""
    rows = np.unique(np.linspace(0, len(paths) - 1, MAX_FILES).astype(int))
    return [path for path in (paths[row] for row in rows) if path.is_file() and path.stat().st_size]


def _has_enough_points(paths: Sequence[Path], format: RecordFormat) -> bool:
    return sum(path.stat().st_size for path in paths) >= MIN_POINTS * record_type(format).itemsize


def _misfit(paths: Sequence[Path], format: RecordFormat) -> str:
    """Return the reason why at least half of the files are no scans in this format, or an empty string."""
    clouds, reasons = [], []
    for path in paths:
        try:
            with np.errstate(invalid="ignore"):  # bytes of another number type may be NaN
                points = read_records(path, format).cloud[:MAX_POINTS].astype(np.float64)
        except (OSError, ValueError):
            width = record_type(format).itemsize
            reasons.append(f"a size that is not a multiple of {width} bytes, or an unreadable file")
            continue
        points[(points == 0).all(axis=1)] = np.nan  # a laser without an echo; the row is kept for `_periodic`
        if reason := _implausible(points[~np.isnan(points).all(axis=1)]):
            reasons.append(reason)
        else:
            clouds.append(points)
    if 2 * len(reasons) >= len(paths):
        return max(set(reasons), key=reasons.count)
    return next((reason for period in PERIODS if (reason := _periodic(clouds, period))), "")


def _implausible(points: Float[np.ndarray, "n 3"]) -> str:
    """Return the reason why points cannot be those of a scan in metres, or an empty string."""
    if not len(points):
        return "all points NaN or 0"
    size = np.abs(points)
    in_range = (size <= MAX_COORDINATE_M) & ((size >= MIN_COORDINATE_M) | (size == 0))
    valid = in_range.all(axis=1)  # False for NaN
    if (~valid).mean() > MAX_INVALID_FRACTION:
        return f"{(~valid).mean():.0%} of the points not finite or beyond {MAX_COORDINATE_M:g} m"
    points = points[valid]
    if (np.abs(np.linalg.norm(points, axis=1) - 1) < 1e-4).mean() > MAX_INVALID_FRACTION:
        return "points 1 m away, like normals"
    if np.median(np.hypot(points[:, 0], points[:, 1])) > MAX_MEDIAN_DISTANCE_M:
        return f"half of the points beyond {MAX_MEDIAN_DISTANCE_M:g} m"
    if np.abs(points).max() <= SCALED_M:
        return f"all points within {SCALED_M:g} m, as in scaled clouds"
    if np.ptp(points[:, :2], axis=0).min() < 0.1:
        return "all points with the same x or y"
    x, y, z = np.sort(points.T)
    if max(_kolmogorov_smirnov(a, b) for a, b in ((x, y), (y, z), (z, x))) < MIN_AXES_DIFFERENCE:
        return "x, y and z distributed alike, as in files with one column after the other"
    return ""


def _periodic(clouds: Sequence[Float[np.ndarray, "_ 3"]], period: int) -> str:
    """Return how every `period`-th row of the clouds differs from the other rows, or an empty string."""
    subsets = [np.concatenate([points[start::period] for points in clouds]) for start in range(period)]
    subsets = [points[~np.isnan(points).any(axis=1), :2].T for points in subsets]  # x and y of valid points
    smallest = min(xy.shape[1] for xy in subsets)
    if smallest < MIN_POINTS / 2 / period:
        return f"every {period}th point missing"
    limit = MAX_DIRECTION_DIFFERENCE + 1.6 * np.sqrt(2 / smallest)  # plus the difference by chance (1% level)
    for fold in (np.asarray, np.abs):  # all directions, then all folded into one quadrant
        first, *others = (np.sort(np.arctan2(fold(y), fold(x))) for x, y in subsets)
        if max(_kolmogorov_smirnov(first, other) for other in others) > limit:
            return f"every {period}th point in another direction"
    distances_m = [np.median(np.hypot(x, y)) for x, y in subsets]
    differ = max(distances_m) > MAX_DISTANCE_RATIO * min(distances_m)
    return f"every {period}th point at another distance" if differ else ""


def _kolmogorov_smirnov(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"]) -> float:
    """Return the maximum difference of the empirical distribution functions of two sorted samples."""
    thresholds = np.concatenate([a, b])
    a_share, b_share = (np.searchsorted(sample, thresholds, side="right") / len(sample) for sample in (a, b))
    return float(np.abs(a_share - b_share).max())
