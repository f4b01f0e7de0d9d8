"""Submaps of the PointNetVLAD benchmark (Oxford RobotCar and three districts): known, and refused.

    2014-05-19-13-20-57/pointcloud_20m_10overlap/1400505794141322.bin   float64 x, y, z, 4096 points
    2014-05-19-13-20-57/pointcloud_locations_20m_10overlap.csv          timestamp, northing, easting
    business_run1/pointcloud_25m_25/*.bin, pointcloud_centroids_25.csv

An image counts points in cells of metres around a sensor. These have no sensor, and each submap is scaled into [-1, 1]
by a factor of its own that is not kept (docs/decisions/data.md). Read as a plain folder they would look like scans.
"""

from pathlib import Path

from sglpr_jax.data.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording

TABLES = ("pointcloud_locations_*.csv", "pointcloud_centroids_*.csv")


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the runs in `root`: a folder of submaps, a run, or a folder of runs or of districts."""
    if not root.is_dir():
        return ()
    folders = [root.resolve().parent] if root.name.startswith("pointcloud_") else []
    patterns = [f"{above}{table}" for table in TABLES for above in ("", "*/", "*/*/")]
    tables = [path for folder in folders for table in TABLES for path in folder.glob(table)]
    tables += [path for pattern in patterns for path in root.glob(pattern)]
    return tuple(sorted({path.resolve().parent.name for path in tables}))


def refuse(root: Path, name: str, options: ReadOptions) -> Recording:
    """Raise ValueError, which says why."""
    raise ValueError(
        f"{root}: expected scans in metres, found submaps ({name}, PointNetVLAD's benchmark): each is scaled into"
        " [-1, 1] by a factor that is not kept, and has neither a sensor nor the ground; open the dataset's own scans"
    )


READER = Reader(
    layout="",
    recording_names=recording_names,
    open=refuse,
    rank=2,
)
