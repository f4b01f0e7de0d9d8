"""Reads text files with one row of numbers per frame: poses (KITTI, TUM, csv) and timestamps."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.choices import PoseFormat, TimeUnit
from sglpr_jax.data.times import ADVICE, times_of
from sglpr_jax.fields import check_value
from sglpr_jax.files import warn
from sglpr_jax.se3 import are_rotations, from_quaternions, have_unit_length, poses_of

CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Transform from LiDAR axes (x forward, y left, z up) to camera axes (x right, y down, z forward), same origin."""
FARTHEST_POSITION_M = 1e8
"""Maximum absolute coordinate of a position, in metres."""
MAX_HEIGHT_RANGE_M = 100.0
"""Maximum range of heights in metres. A larger range is accepted if both horizontal ranges exceed it."""
JUMP_M = 10.0
JUMP_STEPS = 8.0
"""A step between two scans is a jump if it exceeds `JUMP_M` metres and `JUMP_STEPS` times the median step."""
TIME_COLUMNS = ("t", "time", "timestamp")
"""Names of the csv column with the times in seconds, in any case."""
TIME_COLUMNS_S = ("t_s", "time_s", "timestamp_s", "seconds")
"""Names with a unit. They are used if the file has no column named in `TIME_COLUMNS`."""


def check_positions(source: Path | str, positions: Float[np.ndarray, "n 3"]) -> None:
    """Raise ValueError, with the row in `source`, if a coordinate exceeds `FARTHEST_POSITION_M` (1e8 m)."""
    far_rows = np.flatnonzero(np.abs(positions).max(axis=1, initial=0) > FARTHEST_POSITION_M)
    if far_rows.size:
        found = f"{positions[far_rows[0]].tolist()} in row {far_rows[0] + 1}"
        raise ValueError(f"{source}: expected positions in metres, up to {FARTHEST_POSITION_M:g}, found {found}")


def quaternion_poses(
    source: Path | str, positions: Float[np.ndarray, "n 3"], quaternions: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n 4 4"]:
    """Return poses from positions in metres and quaternions x, y, z, w. Errors name the invalid row in `source`."""
    check_positions(source, positions)
    invalid_rows = np.flatnonzero(~have_unit_length(quaternions))
    if invalid_rows.size:
        found = " ".join(f"{value:g}" for value in quaternions[invalid_rows[0]])
        row = f"row {invalid_rows[0] + 1}"
        raise ValueError(f"{source}: expected a rotation qx qy qz qw of length 1 in {row}, found {found}")
    return from_quaternions(positions, quaternions)


def matrix_poses(
    source: Path | str, rows: Float[np.ndarray, "n 12"], *, camera: bool = True
) -> Float[np.ndarray, "n 4 4"]:
    """Return poses from 12 numbers a row, in KITTI's camera axes (converted to z up) or, with `camera=False`, z up.

    Errors name the invalid row in `source`.
    """
    matrices = rows.reshape(-1, 3, 4)
    invalid_rows = np.flatnonzero(~are_rotations(matrices[:, :, :3]))
    if invalid_rows.size:
        found = " ".join(f"{value:g}" for value in matrices[invalid_rows[0]].ravel())
        raise ValueError(f"{source}: expected a rotation and a translation in row {invalid_rows[0] + 1}, found {found}")
    check_positions(source, matrices[:, :, 3])
    poses = poses_of(matrices[:, :, 3], matrices[:, :, :3])
    return CAMERA_FROM_LIDAR.T @ poses @ CAMERA_FROM_LIDAR if camera else poses


def read_times(path: Path, *, unit: TimeUnit = "auto") -> Float[np.ndarray, " n"] | None:
    """Return the times in seconds of a file with one number a line. Warns and returns None for 0, 1, 2, ... (rows)."""
    times = times_of(read_rows(path, columns=1)[:, 0], source=path, unit=unit)
    if times is None:
        warn(f"{path}: expected times, found row numbers (0, 1, 2, ...), not used; {ADVICE}")
    return times


def read_tum(
    path: Path, *, time_unit: TimeUnit = "auto"
) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " n"] | None]:
    """Read the poses of a TUM file (`time x y z qx qy qz qw`), and their times in seconds, None if they count rows."""
    rows = read_rows(path, columns=8)
    times = times_of(rows[:, 0], source=path, unit=time_unit)
    return quaternion_poses(path, rows[:, 1:4], rows[:, 4:]), times


def read_kitti(path: Path, *, camera: bool = True) -> Float[np.ndarray, "n 4 4"]:
    """Read poses from 12 numbers a line, in KITTI's camera axes (converted to z up) or, with `camera=False`, z up."""
    return matrix_poses(path, read_rows(path, columns=12), camera=camera)


def rows_of_frames(rows: Float[np.ndarray, "m ..."], ids: Sequence[str], *, path: Path) -> Float[np.ndarray, "n ..."]:
    """Select the row of each frame from all rows of the file `path`. Frame "000052" has row 52, counted from 0."""
    misnamed = next((name for name in ids if not name.isdecimal()), None)
    if misnamed is not None:
        raise ValueError(f"{path}: expected frames named by their row, such as 000052, found {misnamed!r}")
    row_numbers = [int(name) for name in ids]
    last = max(row_numbers, default=-1)
    if last >= len(rows):
        raise ValueError(f"{path}: expected at least {last + 1} rows (frame {last}), found {len(rows)}")
    return rows[row_numbers]


def read_rows(
    path: Path, *, columns: int, header_lines: int = 0, separator: str | None = None
) -> Float[np.ndarray, "n {columns}"]:
    """Return the finite numbers of a text file with one row a line. Lines that start with # are skipped.

    Columns are separated by white space or by `separator`. A ValueError names the line.
    """
    lines = _lines(path, expected=f"a file with {columns} numbers a line, one line per frame", skip=header_lines)
    rows = [parse_numbers(line.split(separator), columns=columns, where=where) for where, line in lines]
    return np.array(rows, np.float64).reshape(-1, columns)


def read_timed_rows(
    path: Path, *, columns: int, header_lines: int = 0, finite: bool = True
) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n {columns-1}"]]:
    """Return the first column of a table, times as integers of up to 19 digits, and the other columns.

    Columns are separated by commas or white space. With `finite=False`, NaN and infinity are allowed.
    """
    times, rows = [], []
    for where, line in _lines(path, expected="a table of poses", skip=header_lines):
        if words := line.replace(",", " ").split():
            rows.append(parse_numbers(words, columns=columns, where=where, finite=finite))
            times.append(_parse_integer_time(words[0], where=where))
    if not rows:
        raise ValueError(f"{path}: expected rows of a time and {columns - 1} numbers, found none")
    return np.array(times), np.array(rows)[:, 1:]


def _lines(path: Path, *, expected: str, skip: int) -> Iterator[tuple[str, str]]:
    """Yield location ("FILE, line 3") and content of the lines after `skip` header lines, without lines with #."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected {expected}, found none")
    for number, line in enumerate(_text_of(path).rstrip().splitlines(), start=1):
        if number > skip and not line.startswith("#"):
            yield f"{path}, line {number}", line


def _text_of(path: Path) -> str:
    """Return the text of a file without the byte order mark that Excel writes."""
    return path.read_text(encoding="utf-8-sig", errors="replace")


def _parse_integer_time(word: str, *, where: str) -> np.int64:
    """Convert a time such as 1561000444390857630 or 15.0 without loss of digits. Other decimals are rounded."""
    whole, _, fraction = word.partition(".")
    try:
        return np.int64(round(float(word)) if fraction.strip("0") else int(whole))
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{where}: expected a time of up to 19 digits, found {word!r:.40}") from error


def parse_numbers(
    words: Sequence[str], *, columns: int, where: str, finite: bool = True
) -> Float[np.ndarray, " {columns}"]:
    """Convert the words of a line to `columns` numbers, by default finite ones. Errors begin with `where`."""
    if len(words) != columns:
        raise ValueError(f"{where}: expected {columns} numbers, found {len(words)}")
    text = " ".join(words)
    try:
        numbers = np.array(words, dtype=np.float64)
        if "_" in text or not text.isascii():  # numpy parses 1_0 as 10
            raise ValueError("expected digits")
    except ValueError as error:
        raise ValueError(f"{where}: expected numbers, found {text!r:.200}") from error
    if finite and not np.isfinite(numbers).all():
        word = words[int(np.isfinite(numbers).argmin())]
        raise ValueError(f"{where}: expected finite numbers, found {word!r:.40}")
    return numbers


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a sequence, and their times and source."""

    positions: np.ndarray
    """Positions (n, 3) as float64, in metres, z up."""
    times: np.ndarray | None
    """Times (n,) as float64, in seconds, or None."""
    source: str
    """Description of the pose source."""
    by_row: bool = False
    """Whether row i belongs to frame i regardless of the times, because the times are those of the frames."""
    rotations: np.ndarray | None = None
    """Rotations (n, 3, 3) of the frames, or None for csv."""

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Poses of the frames, with identity rotations if the rotations are unknown."""
        return poses_of(self.positions, self.rotations)


FORMATS: dict[str, tuple[str, Callable[[Path, TimeUnit], tuple[np.ndarray, np.ndarray | None]]]] = {
    "kitti": ("camera", lambda path, unit: (read_kitti(path), None)),
    "lidar": ("z up", lambda path, unit: (read_kitti(path, camera=False), None)),
    "tum": ("TUM", lambda path, unit: read_tum(path, time_unit=unit)),
    "csv": ("csv", lambda path, unit: _read_csv(path, unit)),
}
"""Description of each format, and a function that reads poses (n, 4, 4) and times. csv has no rotations."""


def read_trajectory(
    path: Path,
    *,
    format: PoseFormat = "auto",
    times: Path | None = None,
    time_unit: TimeUnit = "auto",
    twelve_numbers: Literal["kitti", "lidar"] | None = None,
) -> Trajectory:
    """Read a pose file with one row per frame. Warns if the range of heights is implausible.

    Arguments:
      path: Pose file.
      format: Format of the pose file. "auto" recognises csv by its ending and tum by its 8 numbers a line.
      times: File of timestamps, one number a line. They replace the times of the pose file.
      time_unit: Unit of the times in both files. "auto" expects seconds.
      twelve_numbers: Format that "auto" assumes for 12 numbers a line, since the axes cannot be detected.
    """
    check_value(format, PoseFormat, f"{path}, format")
    check_value(time_unit, TimeUnit, f"{path}, time_unit")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a pose file, found none")
    file_format = detect_pose_format(path, twelve_numbers=twelve_numbers) if format == "auto" else format
    description, read = FORMATS[file_format]
    # Times that will be replaced are read as seconds, so that an implausible unit is no error.
    poses, seconds = read(path, "s" if times is not None and time_unit == "auto" else time_unit)
    positions = poses[:, :3, 3]
    if not len(positions):
        raise ValueError(f"{path}: expected at least one pose, found none")
    warn_of_heights(positions, source=path)
    if times is not None:
        seconds = read_times(times, unit=time_unit)
        if seconds is not None and len(seconds) != len(positions):
            raise ValueError(f"{times}: expected {len(positions)} times, one per pose, found {len(seconds)}")
    rotations = None if file_format == "csv" else poses[:, :3, :3]
    source = f"{Path(*path.parts[-2:])} ({description})"
    return Trajectory(positions, seconds, source, by_row=times is not None, rotations=rotations)


def warn_of_heights(positions: Float[np.ndarray, "n 3"], *, source: Path | str) -> None:
    """Warn if z ranges over more than `MAX_HEIGHT_RANGE_M` and more than x or y: the axes are probably wrong."""
    x_range, y_range, z_range = np.ptp(positions, axis=0)
    if z_range > MAX_HEIGHT_RANGE_M and z_range > min(x_range, y_range):
        warn(
            f"{source}: expected z up, found heights over {z_range:.0f} m and {x_range:.0f} x {y_range:.0f} m on the"
            " ground; are the poses in another frame (kitti: camera axes, lidar: z up)?"
        )


def warn_of_jumps(positions: Float[np.ndarray, "n 3"], ids: Sequence[str], *, path: Path) -> None:
    """Warn if some or most consecutive scans `ids` are far apart: the poses in `path` may have another order."""
    from scipy.spatial import KDTree  # imported here because the import is slow

    if len(positions) < 3:
        return
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    median_step_m = float(np.median(steps_m))
    jumps = np.count_nonzero(steps_m > max(JUMP_M, JUMP_STEPS * median_step_m))
    # If the whole order is wrong, most steps are long, but each pose has another one near it.
    nearest_m = KDTree(positions).query(positions, k=2)[0][:, 1]  # column 0 is each pose itself
    median_nearest_m = float(np.median(nearest_m))
    if not jumps and median_step_m <= max(JUMP_M, JUMP_STEPS * median_nearest_m):
        return
    i = int(np.argmax(steps_m))
    warn(
        f"{path}: expected consecutive scans near each other, found {ids[i]} and {ids[i + 1]} {steps_m[i]:.0f} m apart"
        f" ({jumps} jumps; half of the steps are below {median_step_m:.1f} m, the median distance to the nearest other"
        f" pose is {median_nearest_m:.1f} m); are the poses in the order of the scans?"
    )


def detect_pose_format(path: Path, *, twelve_numbers: Literal["kitti", "lidar"] | None = None) -> PoseFormat:
    """Return the format of a pose file: csv by its ending, tum by 8 numbers a line, `twelve_numbers` by 12."""
    if path.suffix == ".csv":
        return "csv"
    lines = _text_of(path).splitlines()
    first_line = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    columns = len(first_line.split())
    if columns == 12 and twelve_numbers is not None:
        return twelve_numbers
    if columns != 8:
        found = f"{columns} numbers a line" if columns else "an empty file"
        raise ValueError(
            f"{path}: expected poses as tum (8 numbers a line) or csv, found {found}; for 12 numbers a line, name the"
            " axes with --pose-format or --odometry-format: kitti (camera axes) or lidar (z up)"
        )
    return "tum"


def _read_csv(path: Path, unit: TimeUnit) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " n"] | None]:
    """Read poses (with identity rotations) and times in seconds, if any, from the named columns of a csv file."""
    header = _text_of(path).partition("\n")[0]
    names = [name.strip().lower() for name in header.removeprefix("#").split(",")]  # numpy.savetxt writes the #
    time_names = [name for name in names if name in TIME_COLUMNS] or [name for name in names if name in TIME_COLUMNS_S]
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"{path}: expected a header with x, y and z, found {header[:80]!r}")
    expected = f"one of {', '.join((*TIME_COLUMNS, *TIME_COLUMNS_S))}"
    if len(set(names)) < len(names) or len(time_names) > 1:
        raise ValueError(f"{path}: expected every column once, and {expected}, found {header[:80]!r}")
    unused = [name for name in names if ("time" in name or "stamp" in name) and name not in time_names]
    if unused:
        warn(f"{path}: expected seconds in {expected}, found {', '.join(unused)}, not used")
    columns = dict(zip(names, read_rows(path, columns=len(names), header_lines=1, separator=",").T, strict=True))
    times = times_of(columns[time_names[0]], source=path, unit=unit) if time_names else None
    positions = np.stack([columns[axis] for axis in "xyz"], axis=1)
    check_positions(path, positions)
    return poses_of(positions), times
