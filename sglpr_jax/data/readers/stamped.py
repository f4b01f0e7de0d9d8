"""Shared code of the readers of MulRan, HeLiPR and Boreas: scans named by time, and poses with their own times."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.formats.clouds import Records
from sglpr_jax.data.listing import files_in
from sglpr_jax.data.poses import match_times
from sglpr_jax.data.recording import Record, Recording, found_record

MAX_GAP_S = 0.1
"""Maximum time between a scan and its pose, in seconds: the duration of one sweep."""


def stamped_recording(
    folder: Path,
    name: str,
    *,
    stamps: Int64[np.ndarray, " n"],
    positions: Float[np.ndarray, "n 3"],
    pose_file: Path,
    tick_s: float,
    read_points: Callable[[Path], Records],
    format: str,
) -> Recording:
    """Open the `.bin` files of `folder`. Each scan gets the pose nearest in time.

    Scans without a pose within `MAX_GAP_S` are skipped. `pose_source` contains their number.

    Arguments:
      folder: Folder of the scans, which are named by their time in ticks.
      name: Name of the recording.
      stamps: Time of each pose, in ticks.
      positions: Position of each pose, in metres.
      pose_file: Pose file, for messages.
      tick_s: Duration of a tick, in seconds.
      read_points: Function that reads a scan.
      format: Description of the format.

    Raises:
      FileNotFoundError: If there are no scans.
      ValueError: If a scan is not named by its time, or no scan has a pose.
    """
    paths = files_in(folder, ".bin")
    if not paths:
        raise FileNotFoundError(f"{folder}: expected scans (*.bin), found none")
    strange = next((path.name for path in paths if not path.stem.isdecimal()), None)
    if strange:
        raise ValueError(f"{folder}: expected scans named by their time, as 1561000444390857630.bin, found {strange}")
    times = np.array([int(path.stem) for path in paths], np.int64)
    matched = match_times(stamps, times, tick_s=tick_s, max_gap_s=MAX_GAP_S, poses=pose_file, scans=folder)
    kept = tuple(path for path, keep in zip(paths, matched.kept, strict=True) if keep)
    return Recording(
        name=name,
        ids=tuple(path.stem for path in kept),
        positions=positions[matched.rows],
        times=times[matched.kept] * tick_s,
        pose_source=matched.described(pose_file.name, max_gap_s=MAX_GAP_S),
        paths=kept,
        read=partial(_read, read_points=read_points),
        found=(f"format: {format}",),
        rows=np.flatnonzero(matched.kept),
    )


def _read(path: Path, labels: Path | None, lasers: bool, *, read_points: Callable[[Path], Records]) -> Record:
    return found_record(read_points(path), lasers=lasers)


def read_table(path: Path, *, columns: int, header_lines: int = 0) -> tuple[Int64[np.ndarray, " n"], np.ndarray]:
    """Read a table of poses. Columns are separated by commas or white space.

    Returns:
      First column, the times, as integers of up to 19 digits; and the other columns as float64.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If a line is malformed. The message names the first one.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a table of poses, found none")
    times, rows = [], []
    for number, line in enumerate(path.read_text(errors="replace").splitlines()):
        words = line.replace(",", " ").split()
        if number < header_lines or not words:
            continue
        where = f"{path}, line {number + 1}: expected a time and {columns - 1} finite numbers"
        if len(words) != columns:
            raise ValueError(f"{where}, found {len(words)} words")
        if "_" in line or not line.isascii():  # Python parses 1_0 as 10
            raise ValueError(f"{where}, found {line[:60]!r}")
        try:
            whole, _, fraction = words[0].partition(".")
            times.append(int(whole) if not fraction.strip("0") else round(float(words[0])))
            rows.append([float(word) for word in words[1:]])
        except (ValueError, OverflowError) as error:
            raise ValueError(f"{where}, found {line[:60]!r}") from error
        if not np.isfinite(rows[-1]).all():
            raise ValueError(f"{where}, found {line[:60]!r}")
    if not rows:
        raise ValueError(f"{path}: expected rows of a time and {columns - 1} numbers, found none")
    return np.array(times, np.int64), np.array(rows, np.float64)
