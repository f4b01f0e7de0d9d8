"""Checkpoint file of odometry that is being computed. A run that was killed resumes from it with the same poses."""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.files import replacing
from sglpr_jax.numpy_files import read_arrays
from sglpr_jax.odometry.config import OdometryConfig
from sglpr_jax.retrieval.reuse import fingerprint, scans_sample
from sglpr_jax.schema import Column, check_columns

FORMAT = "sglpr-jax unfinished odometry 1"
COLUMNS = {
    "made_from": Column("uint8", (32,)),
    "poses": Column("float64", ("n", 4, 4)),
    "ends": Column("float64", ("n",)),
}
"""Arrays of the file: hash of the settings, pose of each scan and time of its last point, relative to its own."""
SCANS = 100
"""Number of scans after which the file is written again."""


def settings_hash(
    recording: Recording, config: OdometryConfig, *, scale: Scale, version: str
) -> UInt8[np.ndarray, "32"]:
    """Hash of all that determines the poses: the scans, the settings and the version of kiss-icp."""
    scans = [recording.name, fingerprint(recording), scans_sample(recording)]
    text = json.dumps([FORMAT, version, scale, dataclasses.asdict(config), scans])
    return np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint8)


class KeptPoses:
    """Poses of the first scans of a recording, kept in a file if there is a path."""

    def __init__(self, path: Path | None, made_from: UInt8[np.ndarray, "32"], *, scans: int):
        """Read the file, if it exists. If it has other settings or is damaged, warn and start without poses.

        Arguments:
          path: File of the poses, or None.
          made_from: Hash of the settings (`settings_hash`).
          scans: Number of scans of the recording.
        """
        self._path, self._made_from, self._written = path, made_from, 0
        self.poses: list[np.ndarray] = []
        self.ends: list[float] = []
        if path is not None and path.exists():
            self._read(path, scans)

    def __len__(self) -> int:
        return len(self.poses)

    def add(self, pose: np.ndarray, end: float) -> None:
        """Add the pose of the next scan. Raises WriteError if the file cannot be written."""
        self.poses.append(pose)
        self.ends.append(end)
        if len(self) >= self._written + SCANS:
            self.write()

    def write(self) -> None:
        """Write the file, if there are new poses. Raises WriteError."""
        if self._path is None or self._written == len(self):
            return
        with replacing(self._path) as temporary, temporary.open("wb") as file:
            np.savez(file, made_from=self._made_from, poses=np.array(self.poses), ends=np.array(self.ends))
        self._written = len(self)

    def _read(self, path: Path, scans: int) -> None:
        try:
            found = read_arrays(path, expected="poses of unfinished odometry")
            check_columns(found, COLUMNS)
            if not np.array_equal(found["made_from"], self._made_from) or len(found["poses"]) > scans:
                raise ValueError(f"{path}: expected poses of these scans and settings, found others")
        except ValueError as error:
            warn(f"{error}; the odometry starts again")
            return
        self.poses, self.ends = list(found["poses"]), found["ends"].tolist()
        self._written = len(self)
