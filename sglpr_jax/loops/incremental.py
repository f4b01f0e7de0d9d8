"""Correction of a trajectory while it is driven: an incremental pose graph, solved by gtsam's iSAM2 (extra `gtsam`).

`optimization` solves the same graph at the end and removes wrong loops. Here a robust cost (Cauchy) limits the
influence of a wrong loop.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.config import DriftModel
from sglpr_jax.loops.drift import step_deviations
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.optimization import FIRST_POSE, gtsam_library, rotation_first
from sglpr_jax.loops.transforms import inverse, travelled

CAUCHY = 3.0
"""Residual at which a loop has half its weight, in standard deviations."""
LOOP_EVERY_M = 2.0
"""Minimum travelled distance between the queries of two loops in the graph, in metres. It limits the time of an
update."""
RELINEARIZE = 0.1
"""Change of a pose after which its factors are linearised again, in metres and radians."""


class IncrementalTrajectory:
    """A trajectory of odometry that loops correct frame by frame.

    The loops should come from a `LoopDetector` with the same odometry, which rejects loops that contradict it. A
    segment is a part of the trajectory whose motion is known. A new segment is part of the graph as soon as a loop
    connects it with a segment in the graph.

    Example:
      trajectory = IncrementalTrajectory()
      for points, world_from_lidar in zip(scans, odometry):
          trajectory.add(world_from_lidar, detector.add(points, odometry=world_from_lidar))
          map_from_lidar = trajectory.map_from_world @ world_from_lidar
    """

    def __init__(self, *, drift: DriftModel = DriftModel()):
        """Create a trajectory without frames.

        Arguments:
          drift: Stated drift of the odometry.

        Raises:
          ImportError: If the extra `gtsam` is not installed.
        """
        self._gtsam, self._drift = gtsam_library(), drift
        settings = self._gtsam.ISAM2Params()
        settings.setRelinearizeThreshold(RELINEARIZE)
        settings.relinearizeSkip = 1
        self._solver = self._gtsam.ISAM2(settings)
        self._graph, self._values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        self._odometry = GrowingArray(np.empty((0, 4, 4)))
        self._starts: list[int] = []
        self._placed: set[int] = set()
        self._waiting: list[Loop] = []
        self._last_query: int | None = None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._odometry)

    @property
    def map_from_world(self) -> Float[np.ndarray, "4 4"] | None:
        """Correction of the odometry at the last frame. None if no loop connects its segment with the first one."""
        last = len(self) - 1
        return self._pose(last) @ inverse(self._odometry.rows[last]) if self._is_placed(last) else None

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Corrected pose of the LiDAR at each frame. NaN in segments that no loop connects with the first one."""
        found = np.full((len(self), 4, 4), np.nan)
        estimate = self._solver.calculateEstimate()
        for frame in estimate.keys():  # noqa: SIM118 (a gtsam.Values is no mapping)
            found[frame] = estimate.atPose3(frame).matrix()
        return found

    def add(
        self, world_from_lidar: Float[np.ndarray, "4 4"], loops: Sequence[Loop] = (), *, continues: bool = True
    ) -> None:
        """Add the next frame, and new loops of this and of earlier frames.

        Arguments:
          world_from_lidar: Pose of the LiDAR by odometry.
          loops: New loops.
          continues: False if the motion since the last frame is unknown. The odometry may then begin in another frame.
        """
        frame = len(self)
        self._odometry.append(world_from_lidar)
        if not frame or not continues:
            self._starts.append(frame)
        if not frame:
            self._begin(world_from_lidar)
        elif self._is_placed(frame):
            step = inverse(self._odometry.rows[frame - 1]) @ world_from_lidar
            self._continue(frame, self._pose(frame - 1) @ step)
        self._waiting += loops
        self._use_loops()
        self._solver.update(self._graph, self._values)
        self._graph, self._values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()

    def _begin(self, pose: Float[np.ndarray, "4 4"]) -> None:
        """Insert the first frame, whose pose is fixed."""
        first = self._gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE)
        self._placed.add(0)
        self._values.insert(0, self._gtsam.Pose3(pose))
        self._graph.add(self._gtsam.PriorFactorPose3(0, self._gtsam.Pose3(pose), first))

    def _continue(self, frame: int, pose: Float[np.ndarray, "4 4"]) -> None:
        """Insert a frame at a first estimate of its pose, with its odometry since the previous frame."""
        self._values.insert(frame, self._gtsam.Pose3(pose))
        if frame in self._starts:
            return
        before, after = self._odometry.rows[frame - 1 : frame + 1]
        metres, radians = step_deviations(np.stack([before, after]), self._drift)
        noise = self._gtsam.noiseModel.Diagonal.Sigmas(np.repeat([radians[0], metres[0]], 3))
        step = self._gtsam.Pose3(inverse(before) @ after)
        self._graph.add(self._gtsam.BetweenFactorPose3(frame - 1, frame, step, noise))

    def _use_loops(self) -> None:
        """Add loops with an end in the graph. Others wait until another loop connects their segments."""
        used = True
        while used and self._waiting:
            connected = [self._is_placed(loop.query) or self._is_placed(loop.match) for loop in self._waiting]
            now, self._waiting, used = (
                list(itertools.compress(self._waiting, connected)),
                list(itertools.compress(self._waiting, np.logical_not(connected))),
                any(connected),
            )
            for loop in now:
                self._use(loop)

    def _use(self, loop: Loop) -> None:
        if not self._is_placed(loop.query):
            self._place(loop.query, self._pose(loop.match) @ loop.match_from_query)
        elif not self._is_placed(loop.match):
            self._place(loop.match, self._pose(loop.query) @ inverse(loop.match_from_query))
        elif not self._is_due(loop.query):
            return
        self._last_query = loop.query
        covariance = self._gtsam.noiseModel.Gaussian.Covariance(rotation_first(loop.covariance))
        robust = self._gtsam.noiseModel.mEstimator.Cauchy(CAUCHY)
        noise = self._gtsam.noiseModel.Robust.Create(robust, covariance)
        pose = self._gtsam.Pose3(loop.match_from_query)
        self._graph.add(self._gtsam.BetweenFactorPose3(loop.match, loop.query, pose, noise))

    def _place(self, frame: int, pose: Float[np.ndarray, "4 4"]) -> None:
        """Insert the segment of a frame whose pose is known."""
        segment = self._segment(frame)
        self._placed.add(segment)
        map_from_world = pose @ inverse(self._odometry.rows[frame])
        end = [*self._starts, len(self)][segment + 1]
        for row in range(self._starts[segment], end):
            self._continue(row, map_from_world @ self._odometry.rows[row])

    def _is_due(self, query: int) -> bool:
        """Whether the odometry moved far enough since the last loop in the graph."""
        if self._last_query is None or self._segment(query) != self._segment(self._last_query):
            return True
        first, last = sorted((query, self._last_query))
        return float(travelled(self._odometry.rows[first : last + 1])[-1]) >= LOOP_EVERY_M

    def _segment(self, frame: int) -> int:
        return int(np.searchsorted(self._starts, frame, side="right")) - 1

    def _is_placed(self, frame: int) -> bool:
        return self._segment(frame) in self._placed

    def _pose(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """Latest estimate of the pose of a frame in the graph."""
        if self._values.exists(frame):
            return self._values.atPose3(frame).matrix()
        return self._solver.calculateEstimatePose3(frame).matrix()
