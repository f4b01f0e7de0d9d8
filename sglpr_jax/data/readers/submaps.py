"""Rejects the submaps of the PointNetVLAD benchmark (Oxford RobotCar and three districts) with a clear error.

- `2014-05-19-13-20-57/pointcloud_20m_10overlap/1400505794141322.bin`: float64 x, y, z, 4096 points.
- `2014-05-19-13-20-57/pointcloud_locations_20m_10overlap.csv`: timestamp, northing, easting.
- `business_run1/pointcloud_25m_25/*.bin` and `pointcloud_centroids_25.csv`.

A density image counts points in metric cells around a sensor. Submaps have no sensor. Each submap is scaled to [-1, 1],
and its factor is not stored (docs/decisions.md). Without this reader, a run looks like a plain folder of scans.
"""

from pathlib import Path

from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording

TABLES = ("pointcloud_locations_*.csv", "pointcloud_centroids_*.csv")


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the runs in `root`: a folder of submaps, a run, or a folder of runs or districts."""
    if not root.is_dir():
        return ()
    top = root.resolve().parent if root.name.startswith("pointcloud_") else root
    tables = [path for table in TABLES for above in ("", "*/", "*/*/") for path in top.glob(f"{above}{table}")]
    return tuple(sorted({path.resolve().parent.name for path in tables}))


def refuse(root: Path, name: str, options: ReadOptions) -> Recording:
    raise ValueError(
        f"{root}: expected scans in metres, found submaps ({name}, PointNetVLAD benchmark): each is scaled to"
        " [-1, 1] by an unknown factor, and has neither a sensor nor the ground; open the original scans of the dataset"
    )


READER = Reader("", recording_names, refuse, rank=2)
