"""Reader of PandaSet with scans converted to .npy. The original pickles are not opened, since they can execute code.

- `001/lidar/00.pkl.gz`: the original scan, a pickle.
- `001/lidar/00.npy`: the converted scan (docs/reference/files.md): x, y, z of the LiDAR on the roof, in world axes.
- `001/lidar/poses.json`: position and heading of that LiDAR, one row for each scan.
- `001/lidar/timestamps.json`: timestamps in seconds.

In the LiDAR frame of the dataset, x points right and y forward. The points are rotated so that x points forward. The
world frame has z up.
"""

import hashlib
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.json_tables import poses_in_table, read_table
from sglpr_jax.data.formats.pose_files import rows_of_frames
from sglpr_jax.data.formats.scan_files import read_scan
from sglpr_jax.data.readers.listing import files_in, scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.times import check_order
from sglpr_jax.files import read_json

PICKLES = ".pkl.gz"
POSES = Path("lidar") / "poses.json"


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root`, converted or not. `root` may be a sequence itself."""
    if (root / POSES).is_file():
        return (root.resolve().name,)
    return tuple(sorted(path.parent.parent.name for path in root.glob(f"*/{POSES}")))


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open a sequence. Raises ValueError if its scans are not converted."""
    folder = root / "lidar" if (root / POSES).is_file() else root / name / "lidar"
    pickles = files_in(folder, PICKLES)
    if pickles and not files_in(folder, ".npy"):
        raise ValueError(
            f"{folder}: expected scans as .npy, found {len(pickles)} pickles (*{PICKLES}), which are not opened because"
            " they can execute code; docs/reference/files.md says how to convert them"
        )
    paths = scans_in(folder, ".npy")
    ids = tuple(path.stem for path in paths)
    pose_file, times_file = folder / "poses.json", folder / "timestamps.json"
    poses = poses_in_table(pose_file, read_table(pose_file), position="position", rotation="heading")
    poses = rows_of_frames(poses, ids, path=pose_file)
    times = rows_of_frames(_read_times(times_file), ids, path=times_file)
    check_order(times, source=times_file)
    missing = f", {len(pickles) - len(paths)} pickles not converted" if len(pickles) > len(paths) else ""
    poses_hash = hashlib.sha256(pose_file.read_bytes()).hexdigest()
    return Recording(
        name=name,
        ids=ids,
        paths=paths,
        read=partial(_read, poses=dict(zip(paths, poses, strict=True)), poses_hash=poses_hash),
        positions=poses[:, :3, 3],
        times=times,
        pose_source=str(POSES),
        found=(f"format: PandaSet as npy, transformed from the world frame to the LiDAR frame, x forward{missing}",),
    )


def _read_times(path: Path) -> Float[np.ndarray, " n"]:
    """Read a list of times in seconds from a JSON file. Raises ValueError for other content."""
    content = read_json(path)
    try:
        times = np.array(content, np.float64)
    except (TypeError, ValueError):
        times = np.array([np.nan])  # rejected below
    if times.ndim != 1 or not np.isfinite(times).all():
        raise ValueError(f"{path}: expected a list of seconds, found {str(content)[:60]}")
    return times


def _read(path: Path, labels: Path | None, *, poses: dict[Path, Float[np.ndarray, "4 4"]], poses_hash: str) -> Scan:
    """Read a scan for a `Recording`, transformed from the world to the LiDAR frame with x forward."""
    world_from_lidar = poses[path]  # `poses_hash` is only for caches, which compare the arguments of this function
    in_lidar = (read_scan(path, format="npy") - world_from_lidar[:3, 3]) @ world_from_lidar[:3, :3]
    right, forward, up = in_lidar.T
    return Scan(points=np.stack([forward, -right, up], axis=1).astype(np.float32))


READER = Reader(
    "NNN/lidar/*.npy with NNN/lidar/poses.json (PandaSet)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=5,
)
