"""Publisher of `speed/live.py` for a folder: scans that are renamed when they are whole, and a growing tum file."""

from pathlib import Path

import numpy as np

from sglpr_jax.se3 import quaternions


class FolderPublisher:
    """Writes a scan and a line of odometry at each call."""

    def __init__(self, where: str):
        self._folder = Path(where)
        self._folder.mkdir(exist_ok=True)
        self._poses = self._folder.parent / "poses.tum"
        self._poses.touch()
        self.flags = ("--poses", str(self._poses))

    def put(self, points: np.ndarray, world_from_lidar: np.ndarray, stamp: float) -> None:
        """Publish a scan with its odometry at a time in seconds since 1970."""
        numbers = [stamp, *world_from_lidar[:3, 3], *quaternions(world_from_lidar[None])[0]]
        with self._poses.open("a") as file:
            file.write(" ".join(f"{number:.9f}" for number in numbers) + "\n")
        hidden = self._folder / f".{stamp:.6f}.bin"
        np.pad(points, ((0, 0), (0, 1))).astype("<f4").tofile(hidden)
        hidden.rename(self._folder / f"{stamp:.6f}.bin")


def publisher(where: str) -> FolderPublisher:
    """Publisher for the folder `where`."""
    return FolderPublisher(where)
