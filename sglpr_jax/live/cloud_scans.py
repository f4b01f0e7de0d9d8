"""Points of a live drive on disk, for the point cloud and the grid at its end."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import only
from sglpr_jax.files import replacing
from sglpr_jax.live.data_types import Report
from sglpr_jax.maps.config import CloudConfig
from sglpr_jax.voxels import one_per_voxel

if TYPE_CHECKING:
    from sglpr_jax.live.live_map import LiveMap


SCANS_FOLDER = "cloud-scans"
"""Folder of the scans in that of the map."""


class CloudScans:
    """Stores the scans that a point cloud uses, one file each (000123.npy, by the number of the scan in the map)."""

    def __init__(self, folder: Path, live: "LiveMap", *, config: CloudConfig, report: Report):
        """Continue the folder of a restored map. `config` has the distance of the scans and the size of voxels."""
        self._folder, self._live, self._config, self._report = folder, live, config, report
        self._is_full = False
        for path in folder.glob("[0-9]*.npy"):
            if int(path.stem) >= len(live.odometry):  # the map lost this scan, and will give its number again
                path.unlink()
        numbers = self._numbers()
        self._last_m: Float[np.ndarray, " 3"] | None = live.odometry[numbers[-1], :3, 3] if numbers else None
        """Position of the last stored scan."""

    def _numbers(self) -> list[int]:
        """Return the numbers of the stored scans."""
        return sorted(int(path.stem) for path in self._folder.glob("[0-9]*.npy"))

    def add(self, scan: Scan) -> None:
        """Store the last scan of the map, unless it is near the last stored one. A full disk is reported."""
        if self._is_full or not len(self._live.odometry) or scan.points is None:
            return
        number, position_m = len(self._live) - 1, self._live.odometry[-1, :3, 3]
        if self._last_m is not None and np.linalg.norm(position_m - self._last_m) < self._config.spacing_m:
            return
        points = scan.points[np.isfinite(scan.points).all(axis=1)].astype(np.float32)
        try:
            with replacing(self._folder / f"{number:06d}.npy") as path, path.open("wb") as file:
                np.save(file, one_per_voxel(points, self._config.voxel_m))
        except OSError as error:
            self._is_full = True
            self._report("scans", f"{error}; no more scans are stored for the point cloud")
        self._last_m = position_m.copy()

    def recording(self, sensor_height: SensorHeight) -> tuple[Recording, Float[np.ndarray, "n 4 4"]]:
        """Return the stored scans with their corrected poses. Scans that no loop connects with the first are left out.

        Raises ValueError if no scan is stored.
        """
        numbers, trajectory = self._numbers(), self._live.trajectory
        if not numbers or trajectory is None:
            raise ValueError(f"{self._folder}: expected scans with odometry for the point cloud, found none")
        poses = trajectory.poses[numbers]
        rows = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
        recording = open_recording(self._folder, sensor_height=sensor_height)
        return only(recording, rows.tolist()), poses[rows]
