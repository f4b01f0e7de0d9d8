"""From raw scans to a corrected trajectory: odometry, loops and pose graph in one call (extra `slam`)."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.deskew import deskewed, point_times_problem
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import OnBadScan
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.loops.search import find_loops
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.models.weights import Params
from sglpr_jax.models.weights_file import load
from sglpr_jax.odometry import kiss_icp
from sglpr_jax.odometry.config import OdometryConfig
from sglpr_jax.pose_graph.factor_graph import gtsam_library
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, optimize_trajectory
from sglpr_jax.progress import Progress, no_progress


class Slam(NamedTuple):
    """Odometry of a recording, its loops, and the corrected trajectory."""

    odometry: Float[np.ndarray, "n 4 4"]
    """Pose of the LiDAR at each scan, in the frame of the first scan."""
    loops: LoopSearchResult
    trajectory: OptimizedTrajectory

    def __str__(self) -> str:
        if self.loops.sessions[0].odometry is None:
            return f"{self.loops}\ntrajectory not corrected: the odometry contradicts the scans and is not used"
        return f"{self.loops}\n{self.trajectory}"


def slam(
    recording: Recording | Path | str,
    *,
    params: Params | str = DEFAULT_WEIGHTS,
    config: DetectorConfig = DetectorConfig(),
    odometry: OdometryConfig = OdometryConfig(),
    registered: bool | None = None,
    scale: Scale = 1,
    on_bad_scan: OnBadScan | None = None,
    kept_in: Path | str | None = None,
    progress: Progress = no_progress,
) -> Slam:
    """Compute the odometry of a recording from its scans, find loops and correct the trajectory.

    If scans and points have times, the motion within scans is removed. `bin/loops --odometry auto --optimize` does the
    same and writes files. If the scans contradict the odometry, it is not corrected, and a warning says so.

    Arguments:
      recording: The scans, about 10 a second, or a folder or bag with one recording.
      params: Weights, or their name or folder.
      config: Settings of the loop search.
      odometry: Settings of the odometry.
      registered: See `find_loops`, also for `scale` and `on_bad_scan`.
      scale: Factor for all lengths, also of the odometry.
      on_bad_scan: Called with id and error of an unreadable scan.
      kept_in: Folder of checkpoints, from which an interrupted call resumes. It is not removed.
      progress: Progress display, for instance `sglpr_jax.progress.progress_bar`.

    Raises:
      ValueError: If the recording has ready-made images, or if no scan is readable or has enough points.
      ImportError: If kiss-icp or gtsam is not installed.

    Example:
      result = sglpr_jax.slam("my_scans")
      print(result.trajectory.poses.shape, len(result.loops.loops))
    """
    gtsam_library()  # an error before the search
    scans = recording if isinstance(recording, Recording) else open_recording(Path(recording))
    folder = None if kept_in is None else Path(kept_in)
    with progress(f"odometry {scans.name}", len(scans)) as show:
        poses = kiss_icp.scan_odometry(
            scans,
            config=odometry,
            scale=scale,
            kept_in=None if folder is None else folder / "odometry.log",
            on_bad_scan=on_bad_scan,
            on_progress=show,
        )
    with progress(f"loops {scans.name}", len(scans)) as show:
        loops = find_loops(
            scans if point_times_problem(scans) else deskewed(scans, poses),
            load(params) if isinstance(params, str) else params,
            odometry=poses,
            config=config,
            registered=registered,
            scale=scale,
            on_bad_scan=on_bad_scan,
            kept_in=None if folder is None else folder / "loops",
            on_progress=show,
        )
    if loops.sessions[0].odometry is None:  # the scans contradict it, as a warning has said
        return Slam(poses, loops, OptimizedTrajectory(poses, np.zeros(len(loops.loops), bool)))
    return Slam(poses, loops, optimize_trajectory(loops))
