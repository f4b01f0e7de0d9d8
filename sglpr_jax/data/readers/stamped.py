"""Shared code of MulRan, HeLiPR, Boreas and NCLT: scans that are named by their time, and poses with other times."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.readers.listing import scans_in
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.times import check_unit, nearest_rows

MAX_GAP_S = 0.1
"""Maximum time between a scan and its pose, in seconds: the duration of one sweep."""


def sequences(root: Path, *parts: Path | str) -> dict[str, Path]:
    """Folder of each sequence by name: those in `root` that contain all `parts`, or `root` itself if it does."""

    def contains_all(folder: Path) -> bool:
        return all((folder / part).exists() for part in parts)

    if contains_all(root):
        return {root.resolve().name: root}
    found = sorted(path for path in root.glob("*") if contains_all(path)) if root.is_dir() else []
    return {path.name: path for path in found}


def stamped_recording(
    folder: Path,
    name: str,
    *,
    stamps: Int64[np.ndarray, " n"],
    positions: Float[np.ndarray, "n 3"],
    pose_file: Path,
    tick_s: float,
    read_points: Callable[[Path], Record],
    max_gap_s: float = MAX_GAP_S,
    **fields: Any,
) -> Recording:
    """Open the `.bin` files of a folder, which are named by their time in ticks, each with the nearest pose in time.

    Arguments:
      folder: Folder of the scans.
      name: Name of the recording.
      stamps: Time of each pose, in ticks.
      positions: Position of each pose, in metres.
      pose_file: Pose file, for messages.
      tick_s: Duration of a tick, in seconds.
      read_points: Function that reads a scan.
      max_gap_s: Maximum time between a scan and its pose, in seconds. Other scans are skipped.
      fields: More fields of the recording.

    Raises FileNotFoundError without scans, and ValueError for a scan with another name, no poses or a change of units.
    """
    paths = scans_in(folder, ".bin")
    strange = next((path.name for path in paths if not path.stem.isdecimal()), None)
    if strange:
        raise ValueError(f"{folder}: expected scans named by their time, as 1561000444390857630.bin, found {strange}")
    times = np.array([int(path.stem) for path in paths], np.int64)
    order = np.argsort(stamps, kind="stable")
    check_unit(stamps[order] * tick_s, source=pose_file)
    check_unit(times * tick_s, source=folder)
    nearest = order[nearest_rows(stamps[order], times)]
    gaps_s = np.abs(stamps[nearest] - times) * tick_s
    rows = np.flatnonzero(gaps_s <= max_gap_s)
    if not len(rows):
        raise ValueError(
            f"{pose_file}: expected poses within {max_gap_s:g} s of the scans in {folder}, found the nearest "
            f"{gaps_s.min():g} s away"
        )
    left_out = len(paths) - len(rows)
    said = f" ({left_out} of {len(paths)} scans left out: no pose within {max_gap_s:g} s)" if left_out else ""
    return Recording(
        name=name,
        ids=tuple(paths[row].stem for row in rows),
        paths=tuple(paths[row] for row in rows),
        read=lambda path, labels, lasers: read_points(path),
        positions=positions[nearest[rows]],
        times=times[rows] * tick_s,
        pose_source=f"{pose_file.name}{said}",
        rows=rows,
        **fields,
    )


def read_table(path: Path, *, columns: int, header_lines: int = 0) -> tuple[Int64[np.ndarray, " n"], np.ndarray]:
    """Read the first column, times as integers of up to 19 digits, and the other columns (float64) of a table of poses.

    Columns are separated by commas or white space. Raises FileNotFoundError, or ValueError with the first malformed
    line.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a table of poses, found none")
    times, rows = [], []
    for number, line in enumerate(path.read_text(errors="replace").splitlines()):
        words = line.replace(",", " ").split()
        if number < header_lines or not words:
            continue
        try:
            whole, _, fraction = words[0].partition(".")
            times.append(int(whole) if not fraction.strip("0") else round(float(words[0])))
            rows.append([float(word) for word in words[1:]])
        except (ValueError, OverflowError):
            words = []
        # Python parses 1_0 as 10.
        if len(words) != columns or "_" in line or not line.isascii() or not np.isfinite(rows[-1]).all():
            expected = f"{path}, line {number + 1}: expected a time and {columns - 1} finite numbers"
            raise ValueError(f"{expected}, found {line[:60]!r}")
    if not rows:
        raise ValueError(f"{path}: expected rows of a time and {columns - 1} numbers, found none")
    return np.array(times, np.int64), np.array(rows, np.float64)
