"""Poses from a file that another program appends to: a line for each scan, or tum lines with times."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseFormat, TimeUnit
from sglpr_jax.data.formats.pose_files import CAMERA_FROM_LIDAR, numbers_of, rotations_of
from sglpr_jax.data.poses import BEYOND_S, interpolate, interpolate_turns, poses_of
from sglpr_jax.data.times import PER_SECOND
from sglpr_jax.growing import GrowingArray

AROUND = 25
"""Number of poses before and after a time between which a pose is interpolated."""


class GrowingPoses:
    """Reads new whole lines of a file at each look. The file need not exist yet."""

    def __init__(self, path: Path, format: PoseFormat, time_unit: TimeUnit):
        """Begin with nothing read. Raises ValueError if the format cannot be that of a growing file."""
        if format == "csv":
            raise ValueError(f"{path}: expected poses as tum, kitti or lidar, found csv")
        self._path, self._format, self._unit = path, format, PER_SECOND[time_unit]
        self._read = self._line = 0
        self._rows: GrowingArray | None = None

    def __len__(self) -> int:
        return 0 if self._rows is None else len(self._rows)

    def look(self) -> None:
        """Read the lines that were added since the last look.

        Raises ValueError if one of them is invalid. The other ones are read; the scan of that line has no pose.
        """
        if not self._path.is_file():
            return
        with self._path.open("rb") as file:
            file.seek(self._read)
            new = file.read()
        whole = new[: new.rfind(b"\n") + 1]
        self._read += len(whole)
        wrong = None
        for line in whole.decode(errors="replace").splitlines():
            self._line += 1
            try:
                if line.strip() and not line.startswith("#"):
                    self._add(line.split(), f"{self._path}, line {self._line}")
            except ValueError as error:
                wrong = wrong or error
        if wrong is not None:
            raise wrong

    def of(self, row: int, time: float | None) -> Float[np.ndarray, "4 4"] | None:
        """Pose of a scan, or None if the file does not have it yet.

        Arguments:
          row: Number of the scan in its folder, for files with a line for each scan, and scans without times.
          time: Time of the scan in seconds, for tum files, or None.
        """
        if self._rows is None:
            return None
        if time is not None and self._rows.rows.shape[1] == 8:
            return self._at(time)
        known = row < len(self) and np.isfinite(self._rows.rows[row]).all()
        return self._poses(self._rows.rows[row : row + 1])[0] if known else None

    def _add(self, words: list[str], where: str) -> None:
        if self._rows is None:
            self._rows = GrowingArray(np.empty((0, self._columns(len(words), where))))
        unknown = np.full(self._rows.rows.shape[1], np.nan)
        unknown[0] = self._rows.rows[-1, 0] if len(self) else 0.0  # times stay in order
        self._rows.append(unknown)  # also if the line is invalid: the next line is that of the next scan
        self._rows.rows[-1] = numbers_of(words, columns=len(unknown), where=where)

    def _columns(self, found: int, where: str) -> int:
        if self._format == "auto" and found == 12:
            raise ValueError(
                f"{where}: expected the axes of 12 numbers a line, found none; pass --pose-format kitti or lidar"
            )
        return 8 if self._format in ("auto", "tum") else 12

    def _at(self, time: float) -> Float[np.ndarray, "4 4"] | None:
        """Pose interpolated at a time, or None if the poses do not reach it."""
        assert self._rows is not None
        middle = int(np.searchsorted(self._rows.rows[:, 0], time * self._unit))
        rows = self._rows.rows[max(middle - AROUND, 0) : middle + AROUND]
        rows = rows[np.isfinite(rows).all(axis=1)]
        stamps = rows[:, 0] / self._unit
        if len(stamps) < 2 or stamps[-1] < time - BEYOND_S:
            return None
        found = interpolate(stamps, rows[:, 1:4], np.array([time]))
        if not found.kept.all():
            return None
        turns = rows[:, 4:] / np.linalg.norm(rows[:, 4:], axis=1, keepdims=True)
        return poses_of(found.positions, interpolate_turns(stamps, turns, np.array([time])))[0]

    def _poses(self, rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n 4 4"]:
        if rows.shape[1] == 8:
            return poses_of(rows[:, 1:4], rotations_of(self._path, rows[:, 4:]))
        matrices = rows.reshape(-1, 3, 4)
        poses = poses_of(matrices[:, :, 3], matrices[:, :, :3])
        return CAMERA_FROM_LIDAR.T @ poses @ CAMERA_FROM_LIDAR if self._format == "kitti" else poses
