"""Correction of a trajectory while it is driven: an incremental pose graph, solved by gtsam's iSAM2 (extra `gtsam`).

A robust cost (Cauchy) limits the influence of a wrong loop. `optimize` solves the whole graph at the end instead.
"""

import bisect
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.odometry_deviation import step_deviations
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.factor_graph import FactorGraph, gtsam_library, rotation_first
from sglpr_jax.se3 import inverse

CAUCHY = 3.0
"""Residual at which a loop has half its weight, in standard deviations."""
NODE_EVERY_M = 5.0
"""Travelled distance between two nodes of a new graph, in metres."""
MOST_NODES = 4000
"""Number of nodes at which this distance doubles, so that time and memory stay bounded."""
NODE_BYTES = 5000
"""Approximate memory of a node with its factors in the solver, in bytes."""
LOOP_EVERY = 10
"""Minimum distance between two loops in the graph that agree with it, as a multiple of the distance between two nodes.
It limits the growth of time and memory on routes that are driven again and again."""
AGREEMENT_SIGMAS = 4.0
"""Maximum residual of a loop that agrees with the graph, in standard deviations. Of right loops, 99 % have less."""
RELINEARIZE = 0.1
"""Change of a pose after which its factors are linearised again, in metres and radians."""


class IncrementalTrajectory:
    """A trajectory of odometry that loops correct frame by frame.

    The loops should come from a `LoopDetector` with the same odometry, which rejects loops that contradict it. The
    graph has a node every few metres, and a loop connects the nodes before its query and its match. On a long drive,
    the distance between nodes grows. Where the motion is unknown, a new segment begins. It enters the graph when a loop
    connects it with a segment in the graph.

    Example:
      trajectory = IncrementalTrajectory()
      for points, world_from_lidar in zip(scans, odometry):
          trajectory.add(world_from_lidar, detector.add(points, odometry=world_from_lidar))
          map_from_lidar = trajectory.map_from_world @ world_from_lidar
    """

    def __init__(self, *, drift: DriftModel = DriftModel()):
        """Create a trajectory without frames. Raises ImportError if the extra `gtsam` is not installed."""
        self._gtsam, self._drift = gtsam_library(), drift
        self._odometry = GrowingArray(np.empty((0, 4, 4)))
        self._travelled = GrowingArray(np.empty(0))
        self._node_every_m = NODE_EVERY_M
        self._node_frames: list[int] = []  # frame of each node. Nodes are named by their frames, also in the graph.
        self._node_segments: list[int] = []  # segment of each node, counted from 0
        self._waiting_loops: list[LoopClosure] = []  # loops between two segments that are not in the graph
        self._begin_graph()

    def _begin_graph(self) -> None:
        """Begin a graph without nodes."""
        settings = self._gtsam.ISAM2Params()
        settings.setRelinearizeThreshold(RELINEARIZE)
        settings.relinearizeSkip = 1
        self._solver = self._gtsam.ISAM2(settings)
        self._graph = FactorGraph()  # factors and nodes since the last update of the solver
        self._segments_in_graph = {0}  # segments whose nodes are in the graph
        self._loops: list[LoopClosure] = []  # loops in the graph
        self._last_query_node = 0  # node of the query of the last one

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._odometry)

    @property
    def nbytes(self) -> int:
        """Number of bytes of the poses, and about as many as the graph has."""
        return self._odometry.nbytes + self._travelled.nbytes + NODE_BYTES * len(self._node_frames)

    @property
    def map_from_world(self) -> Float[np.ndarray, "4 4"] | None:
        """Transform from the odometry's frame to the map at the last frame. None if its segment is not in the graph."""
        if self._node_segments[-1] not in self._segments_in_graph:
            return None
        return self._correction_at(self._node_frames[-1])

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Corrected pose of the LiDAR at each frame. NaN in segments that loops do not connect with the first."""
        poses = np.full((len(self), 4, 4), np.nan)
        ends = [*self._node_frames[1:], len(self)]
        for node, end, segment in zip(self._node_frames, ends, self._node_segments, strict=True):
            if segment in self._segments_in_graph:
                poses[node:end] = self._correction_at(node) @ self._odometry.rows[node:end]
        return poses

    def add(
        self, world_from_lidar: Float[np.ndarray, "4 4"], loops: Sequence[LoopClosure] = (), *, continues: bool = True
    ) -> None:
        """Add the pose of the LiDAR by odometry at the next frame, and new loops of this and of earlier frames. With
        `continues=False`, the motion since the last frame is unknown, and the odometry may begin in another frame."""
        frame = len(self)
        travelled_m = 0.0
        if frame:
            travelled_m = float(self._travelled.rows[-1])
            if continues:
                travelled_m += float(np.linalg.norm(world_from_lidar[:3, 3] - self._odometry.rows[-1, :3, 3]))
        self._odometry.append(world_from_lidar)
        self._travelled.append(travelled_m)
        if not frame:
            self._node_frames, self._node_segments = [0], [0]
            self._graph.add_node(0, world_from_lidar, fixed=True)
        else:
            last = self._node_frames[-1]
            segment = self._node_segments[-1] + (not continues)  # one more if the motion is unknown
            if not continues or travelled_m - self._travelled.rows[last] >= self._node_every_m:
                self._node_frames.append(frame)
                self._node_segments.append(segment)
                if continues and segment in self._segments_in_graph:
                    self._graph.add_node(frame, self._correction_at(last) @ world_from_lidar)
                    self._add_step(last, frame)
        self._waiting_loops += loops
        self._add_waiting_loops()
        self._update()
        if len(self._node_frames) > MOST_NODES:
            self._halve_nodes()

    def _update(self) -> None:
        """Give the new factors and nodes to the solver."""
        if self._graph.estimates.size() or self._graph.factors.size():
            self._solver.update(self._graph.factors, self._graph.estimates)
            self._graph = FactorGraph()  # the solver has these factors now

    def _halve_nodes(self) -> None:
        """Begin the graph anew with twice the distance between nodes. The first node of each segment stays."""
        segments, loops, travelled = self._segments_in_graph, self._loops, self._travelled.rows
        estimates = {node: self._pose(node) for segment in segments for node in self._nodes_of(segment)}
        self._node_every_m *= 2
        kept = list[int]()
        for i, (node, segment) in enumerate(zip(self._node_frames, self._node_segments, strict=True)):
            is_first = i == 0 or segment != self._node_segments[kept[-1]]
            if is_first or travelled[node] - travelled[self._node_frames[kept[-1]]] >= self._node_every_m:
                kept.append(i)
        self._node_frames = [self._node_frames[i] for i in kept]
        self._node_segments = [self._node_segments[i] for i in kept]
        self._begin_graph()
        self._segments_in_graph = segments
        for segment in segments:
            nodes = self._nodes_of(segment)
            for node in nodes:
                self._graph.add_node(node, estimates[node], fixed=node == 0)
            for before, after in itertools.pairwise(nodes):
                self._add_step(before, after)
        for loop in loops:
            self._connect(loop, *self._between_nodes(loop))
        self._update()

    def _add_waiting_loops(self) -> None:
        """Add the waiting loops with an end in the graph. Repeats, because each may connect a segment for others."""
        while True:
            usable, unusable = [], []
            for loop in self._waiting_loops:
                segments = {self._segment_of(loop.query), self._segment_of(loop.match)}
                loops = unusable if segments.isdisjoint(self._segments_in_graph) else usable
                loops.append(loop)
            self._waiting_loops = unusable
            if not usable:
                return
            for loop in usable:
                self._add_loop(loop)

    def _add_loop(self, loop: LoopClosure) -> None:
        """Connect the nodes before query and match of a loop. At least one of them is in the graph. If the other node
        is not, its segment enters the graph. A loop that adds no information is ignored. The covariance stays that of
        the loop, because the nodes are near its frames."""
        query, match, match_from_query = self._between_nodes(loop)
        if self._segment_of(query) not in self._segments_in_graph:
            self._add_segment(query, self._pose(match) @ match_from_query)
        elif self._segment_of(match) not in self._segments_in_graph:
            self._add_segment(match, self._pose(query) @ inverse(match_from_query))
        elif query == match or not self._adds_information(loop, query, match, match_from_query):
            return
        self._connect(loop, query, match, match_from_query)

    def _between_nodes(self, loop: LoopClosure) -> tuple[int, int, Float[np.ndarray, "4 4"]]:
        """Return the nodes before query and match of a loop, and the pose of the first in the frame of the second."""
        query, match = self._node_before(loop.query), self._node_before(loop.match)
        odometry = self._odometry.rows
        query_from_frame = inverse(odometry[query]) @ odometry[loop.query]
        match_from_frame = inverse(odometry[match]) @ odometry[loop.match]
        return query, match, match_from_frame @ loop.match_from_query @ inverse(query_from_frame)

    def _connect(self, loop: LoopClosure, query: int, match: int, match_from_query: Float[np.ndarray, "4 4"]) -> None:
        """Connect two nodes by a loop, unless they are the same one."""
        if query != match:
            self._last_query_node = query
            self._loops.append(loop)
            self._graph.add_loop(match, query, match_from_query, loop.covariance, cauchy=CAUCHY)

    def _adds_information(
        self, loop: LoopClosure, query: int, match: int, match_from_query: Float[np.ndarray, "4 4"]
    ) -> bool:
        """Whether a loop contradicts the graph, or is at least `LOOP_EVERY` nodes of travel from the last added one."""
        if query == self._last_query_node:
            return False
        travelled = self._travelled.rows
        if abs(travelled[query] - travelled[self._last_query_node]) >= LOOP_EVERY * self._node_every_m:
            return True
        error = inverse(match_from_query) @ inverse(self._pose(match)) @ self._pose(query)
        residual = self._gtsam.Pose3.Logmap(self._gtsam.Pose3(error))
        return float(residual @ np.linalg.solve(rotation_first(loop.covariance), residual)) > AGREEMENT_SIGMAS**2

    def _add_segment(self, node: int, pose: Float[np.ndarray, "4 4"]) -> None:
        """Add all nodes of the segment of `node` to the graph, placed by the pose of `node` in the map."""
        segment = self._segment_of(node)
        self._segments_in_graph.add(segment)
        nodes = self._nodes_of(segment)
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

    def _nodes_of(self, segment: int) -> list[int]:
        """Return the nodes of a segment."""
        return [node for node, own in zip(self._node_frames, self._node_segments, strict=True) if own == segment]

    def _node_before(self, frame: int) -> int:
        """Return the last node at or before a frame."""
        return self._node_frames[bisect.bisect_right(self._node_frames, frame) - 1]

    def _segment_of(self, frame: int) -> int:
        """Return the segment of a frame."""
        return self._node_segments[bisect.bisect_right(self._node_frames, frame) - 1]

    def _correction_at(self, node: int) -> Float[np.ndarray, "4 4"]:
        """Return the transform from the odometry's frame to the map, at a node in the graph."""
        return self._pose(node) @ inverse(self._odometry.rows[node])

    def _pose(self, node: int) -> Float[np.ndarray, "4 4"]:
        """Return the latest estimate of a node's pose in the map."""
        if self._graph.estimates.exists(node):
            return self._graph.estimates.atPose3(node).matrix()
        return self._solver.calculateEstimatePose3(node).matrix()
