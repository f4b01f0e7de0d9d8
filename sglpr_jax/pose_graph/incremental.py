"""Correction of a trajectory while it is driven: an incremental pose graph, solved by gtsam's iSAM2 (extra `gtsam`).

`optimize` solves a graph of all frames and loops at the end, and removes wrong loops. Here a robust cost (Cauchy)
limits the influence of a wrong loop.
"""

import bisect
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.drift import step_deviations
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.factor_graph import FactorGraph, gtsam_library, rotation_first
from sglpr_jax.se3 import inverse

CAUCHY = 3.0
"""Residual at which a loop has half its weight, in standard deviations."""
NODE_EVERY_M = 5.0
"""Travelled distance between two nodes of the graph, in metres."""
LOOP_EVERY_M = 50.0
"""Minimum travelled distance between two loops in the graph that agree with it, in metres. It limits the growth of time
and memory on routes that are driven again and again."""
AGREES = 4.0
"""Maximum residual of a loop that agrees with the graph, in standard deviations. Of right loops, 99 % have less."""
RELINEARIZE = 0.1
"""Change of a pose after which its factors are linearised again, in metres and radians."""


class IncrementalTrajectory:
    """A trajectory of odometry that loops correct frame by frame.

    The loops should come from a `LoopDetector` with the same odometry, which rejects loops that contradict it. A
    segment, a part whose motion is known, enters the graph as soon as a loop connects it with a segment in the graph.
    The graph has a node every few metres. A loop connects the nodes before its query and its match.

    Example:
      trajectory = IncrementalTrajectory()
      for points, world_from_lidar in zip(scans, odometry):
          trajectory.add(world_from_lidar, detector.add(points, odometry=world_from_lidar))
          map_from_lidar = trajectory.map_from_world @ world_from_lidar
    """

    def __init__(self, *, drift: DriftModel = DriftModel()):
        """Create a trajectory without frames. Raises ImportError if the extra `gtsam` is not installed."""
        self._gtsam, self._drift = gtsam_library(), drift
        settings = self._gtsam.ISAM2Params()
        settings.setRelinearizeThreshold(RELINEARIZE)
        settings.relinearizeSkip = 1
        self._solver = self._gtsam.ISAM2(settings)
        self._graph = FactorGraph()
        """Factors and nodes since the last update of the solver."""
        self._odometry = GrowingArray(np.empty((0, 4, 4)))
        self._travelled = GrowingArray(np.empty(0))
        self._nodes: list[int] = []
        self._segments: list[int] = []
        """Frame and segment of each node. The keys of the graph are these frames."""
        self._connected = {0}
        """Segments in the graph."""
        self._waiting: list[LoopClosure] = []
        """Loops between segments that are not in the graph."""
        self._last_query = 0

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._odometry)

    @property
    def map_from_world(self) -> Float[np.ndarray, "4 4"] | None:
        """Correction of the odometry at the last frame. None if no loop connects its segment with the first one."""
        return self._correction(self._nodes[-1]) if self._segments[-1] in self._connected else None

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Corrected pose of the LiDAR at each frame. NaN in segments that no loop connects with the first one."""
        poses = np.full((len(self), 4, 4), np.nan)
        for node, end, segment in zip(self._nodes, [*self._nodes[1:], len(self)], self._segments, strict=True):
            if segment in self._connected:
                poses[node:end] = self._correction(node) @ self._odometry.rows[node:end]
        return poses

    def add(
        self, world_from_lidar: Float[np.ndarray, "4 4"], loops: Sequence[LoopClosure] = (), *, continues: bool = True
    ) -> None:
        """Add the pose of the LiDAR by odometry at the next frame, and new loops of this and of earlier frames.

        With `continues=False`, the motion since the last frame is unknown, and the odometry may begin in another frame.
        """
        frame, before = len(self), self._odometry.rows[-1:]
        self._odometry.append(world_from_lidar)
        step = float(np.linalg.norm(world_from_lidar[:3, 3] - before[-1, :3, 3])) if frame and continues else 0.0
        self._travelled.append(self._travelled.rows[-1] + step if frame else 0.0)
        if not frame:
            self._nodes, self._segments = [0], [0]
            self._graph.add_node(0, world_from_lidar, fixed=True)
        else:
            last, segment = self._nodes[-1], self._segments[-1] + (not continues)
            if not continues or self._travelled.rows[-1] - self._travelled.rows[last] >= NODE_EVERY_M:
                self._nodes.append(frame)
                self._segments.append(segment)
                if continues and segment in self._connected:
                    self._graph.add_node(frame, self._correction(last) @ world_from_lidar)
                    self._add_step(last, frame)
        self._waiting += loops
        self._use_loops()
        if self._graph.estimates.size() or self._graph.factors.size():
            self._solver.update(self._graph.factors, self._graph.estimates)
            self._graph = FactorGraph()

    def _use_loops(self) -> None:
        """Add loops with an end in the graph. Others wait until another loop connects their segments."""
        while True:
            usable, waiting = [], []
            for loop in self._waiting:
                segments = {self._segment(loop.query), self._segment(loop.match)}
                (waiting if segments.isdisjoint(self._connected) else usable).append(loop)
            self._waiting = waiting
            if not usable:
                return
            for loop in usable:
                self._use(loop)

    def _use(self, loop: LoopClosure) -> None:
        """Connect the nodes of a loop. The covariance is that of the loop, because the nodes are near its frames."""
        query, match = self._node(loop.query), self._node(loop.match)
        odometry = self._odometry.rows
        query_from_frame = inverse(odometry[query]) @ odometry[loop.query]
        match_from_frame = inverse(odometry[match]) @ odometry[loop.match]
        match_from_query = match_from_frame @ loop.match_from_query @ inverse(query_from_frame)
        if self._segment(query) not in self._connected:
            self._add_segment(query, self._pose(match) @ match_from_query)
        elif self._segment(match) not in self._connected:
            self._add_segment(match, self._pose(query) @ inverse(match_from_query))
        elif query == match or not self._is_useful(loop, query, match, match_from_query):
            return
        self._last_query = query
        self._graph.add_loop(match, query, match_from_query, loop.covariance, cauchy=CAUCHY)

    def _is_useful(self, loop: LoopClosure, query: int, match: int, match_from_query: Float[np.ndarray, "4 4"]) -> bool:
        """Whether a loop between two nodes contradicts the graph, or no other loop was used for a while."""
        if query == self._last_query:
            return False
        travelled = self._travelled.rows
        if abs(travelled[query] - travelled[self._last_query]) >= LOOP_EVERY_M:
            return True
        error = inverse(match_from_query) @ inverse(self._pose(match)) @ self._pose(query)
        residual = self._gtsam.Pose3.Logmap(self._gtsam.Pose3(error))
        return float(residual @ np.linalg.solve(rotation_first(loop.covariance), residual)) > AGREES**2

    def _add_segment(self, node: int, pose: Float[np.ndarray, "4 4"]) -> None:
        """Add the nodes of a segment to the graph. The pose of one node is known."""
        segment = self._segment(node)
        self._connected.add(segment)
        nodes = [other for other in self._nodes if self._segment(other) == segment]
        map_from_world = pose @ inverse(self._odometry.rows[node])
        for other in nodes:
            self._graph.add_node(other, map_from_world @ self._odometry.rows[other])
        for before, after in itertools.pairwise(nodes):
            self._add_step(before, after)

    def _add_step(self, before: int, after: int) -> None:
        """Connect two nodes by odometry."""
        poses = self._odometry.rows[[before, after]]
        (metres,), (radians,) = step_deviations(poses, self._drift)
        self._graph.add_step(before, after, inverse(poses[0]) @ poses[1], metres=metres, radians=radians)

    def _node(self, frame: int) -> int:
        """Last node at or before a frame."""
        return self._nodes[bisect.bisect_right(self._nodes, frame) - 1]

    def _segment(self, frame: int) -> int:
        return self._segments[bisect.bisect_right(self._nodes, frame) - 1]

    def _correction(self, node: int) -> Float[np.ndarray, "4 4"]:
        """Correction of the odometry at a node in the graph."""
        return self._pose(node) @ inverse(self._odometry.rows[node])

    def _pose(self, node: int) -> Float[np.ndarray, "4 4"]:
        """Latest estimate of the pose of a node in the graph."""
        if self._graph.estimates.exists(node):
            return self._graph.estimates.atPose3(node).matrix()
        return self._solver.calculateEstimatePose3(node).matrix()
