"""Rejects the submaps of the PointNetVLAD benchmark (Oxford RobotCar and three districts) with a clear error.

- `2014-05-19-13-20-57/pointcloud_20m_10overlap/1400505794141322.bin`: float64 x, y, z, 4096 points.
- `2014-05-19-13-20-57/pointcloud_locations_20m_10overlap.csv`: timestamp, northing, easting.
- `business_run1/pointcloud_25m_25/*.bin` and `pointcloud_centroids_25.csv`.

A density image counts points in metric cells around a sensor. Submaps have no sensor, and each submap is scaled to
[-1, 1] by an unknown factor (docs/decisions.md). Without this reader, a run would be opened as a plain folder of scans.
"""

from pathlib import Path

from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording

TABLES = ("pointcloud_locations_*.csv", "pointcloud_centroids_*.csv")
"""Patterns of the pose tables of a run."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the runs in `root`: a folder of submaps, a run, or a folder of runs or districts."""
    if not root.is_dir():
        return ()
    top = root.resolve().parent if root.name.startswith("pointcloud_") else root
    patterns = [f"{parents}{table}" for table in TABLES for parents in ("", "*/", "*/*/")]
    return tuple(sorted({path.resolve().parent.name for pattern in patterns for path in top.glob(pattern)}))


def reject(root: Path, name: str, options: ReadOptions) -> Recording:
    """Raise ValueError with the reason why submaps cannot be read."""
    raise ValueError(
        f"{root}: expected scans in metres, found submaps ({name}, PointNetVLAD benchmark): each is scaled to"
        " [-1, 1] by an unknown factor, and has neither a sensor nor the ground; open the original scans of the dataset"
    )


READER = Reader("", recording_names, reject, rank=2)
