"""Loop detector for a stream of scans."""

import datetime
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from sglpr_jax.data.poses import as_pose
from sglpr_jax.data.scan import Scan, as_scan
from sglpr_jax.data.times import as_seconds
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.closure import LoopClosure, Reason, RejectedClosure
from sglpr_jax.loops.comparison import Candidate, Fits
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.loops.probability import LoopModel, default_model
from sglpr_jax.loops.sequence import WINDOW_M, Pair, pair_of, probable_loops, rejection_reason
from sglpr_jax.models.weights import Params

MAX_WAITING = 240
"""Maximum number of pairs that wait for their neighbours. It limits the computation per frame if the sensor is slow."""
RESULT_BYTES = 1000
"""Memory of a loop, or of a compared or rejected pair, in bytes."""


class LoopDetector:
    """Finds loop closures in a stream of scans or images, with or without times and odometry.

    The sequential test (`loops.sequence`) adds the evidence of neighbouring frames to that of each pair, so the first
    loops of a revisit may be returned some frames late. Pairs that contradict the odometry or, without it, the motion
    estimated from the images, are rejected.

    Example:
      detector = LoopDetector(sglpr_jax.load("sglpr"))
      for i in range(len(recording)):
          for loop in detector.add(recording.points(i), time=recording.times[i]):
              print(loop.query, loop.match, loop.match_from_query, loop.probability)
    """

    def __init__(self, params: Params, *, model: LoopModel | None = None, config: DetectorConfig = DetectorConfig()):
        """Create a detector without frames. By default, `model` is the shipped model of the probabilities."""
        self.finder = CandidateSearch(params, config)
        self.model = default_model() if model is None else model
        self.config = config
        self.candidates: list[Candidate] = []
        """All compared pairs or, with `max_places`, that many of the last ones."""
        self.loops: list[LoopClosure] = []
        """All returned loops."""
        self.rejected: list[RejectedClosure] = []
        """Rejected pairs, with reasons. Left out are other pairs of the query of a loop, improbable pairs that the
        motion excludes, and pairs whose later neighbours may still be added (`undecided`)."""
        self._waiting: list[Pair] = []
        """Pairs whose later neighbours may still be added."""
        self._returned: set[int] = set()
        """Frames of the queries of the returned loops."""
        self._contradicting: set[int] = set()
        """The same for the probable loops that contradict the motion."""

    def __len__(self) -> int:
        """Number of added scans."""
        return self.finder.scans

    @property
    def nbytes(self) -> int:
        """Number of bytes of all frames and, about, of the results, without the kept spectra (17 MB at most).

        With `max_places`, loops, rejected pairs and the motion still grow. The motion grows by 289 bytes a keyframe and
        has up to as much in spare capacity.
        """
        return self.finder.nbytes + RESULT_BYTES * sum(map(len, (self.candidates, self.loops, self.rejected)))

    def add(
        self,
        scan: Scan | ArrayLike,
        *,
        time: float | np.datetime64 | np.timedelta64 | datetime.datetime | datetime.timedelta | None = None,
        odometry: ArrayLike | None = None,
        continues: bool = True,
    ) -> list[LoopClosure]:
        """Add the next scan. Returns the loops that it closes or confirms, of this and of the last few keyframes.

        A scan that is nearer to the last keyframe than `DetectorConfig.keyframe_m` is not searched, but counts in the
        numbers of scans.

        Arguments:
          scan: A `Scan` (with the mounting of its sensor), points (n, 3) in metres, or an image (h, w) from
            `density_bev`.
          time: Time of the scan in any unit, or a date. Only ratios of time steps count.
          odometry: Pose of the LiDAR in a fixed frame. It may drift.
          continues: False if the motion since the last frame is unknown, for example after a restart. The odometry may
            then begin in another frame.

        Raises:
          ValueError: If a value has another shape, if times decrease, or if only some frames have a time or odometry.
          TypeError: If a value is not an array of numbers, for instance a path.
        """
        scan, when = as_scan(scan), {"time": as_seconds(time), "odometry": as_pose(odometry), "continues": continues}
        if not self.finder.is_due(**when):
            self.finder.skip()
            return []
        return self.add_keyframe(self.finder.keyframe(scan), **when)

    def add_keyframe(
        self,
        keyframe: Keyframe | None,
        *,
        time: float | None = None,
        odometry: Float[np.ndarray, "4 4"] | None = None,
        fits: Fits | None = None,
        continues: bool = True,
    ) -> list[LoopClosure]:
        """Find candidates of a described keyframe, and return the loops that are now probable.

        Candidates wait as pairs, because later frames on the next `WINDOW_M` metres may confirm them. Older pairs that
        were not returned are rejected. The arguments are those of `CandidateSearch.add_keyframe`: `keyframe` is None
        for a scan that cannot be read, and `continues` is False if the motion since the last frame is unknown.
        """
        finder = self.finder
        candidates = finder.add_keyframe(keyframe, time=time, odometry=odometry, fits=fits, continues=continues)
        rows = finder.rows
        self.candidates += [
            pair._replace(query=int(rows[pair.query]), match=int(rows[pair.match])) for pair in candidates
        ]
        if self.config.max_places is not None:
            del self.candidates[: -self.config.max_places]
        for candidate in candidates:
            pair = pair_of(candidate, self.model, finder.motion, finder.mountings, knows_height=finder.knows_height)
            self._waiting.append(pair)
        oldest_m = finder.motion.travelled[-1] - WINDOW_M
        expired = sum(pair.travelled_m < oldest_m for pair in self._waiting)
        expired = max(expired, len(self._waiting) - MAX_WAITING)
        self.rejected += self._reject(self._waiting[:expired])
        self._waiting = self._waiting[expired:]
        if not candidates:
            return []
        allowed = [pair for pair in self._waiting if self._is_allowed(pair)]
        excluded = [pair for pair in self._waiting if not self._is_allowed(pair)]
        reason: Reason = "contradicts the odometry" if finder.has_odometry else "contradicts the motion"
        contradicting = self._new_loops(excluded, self._contradicting)
        self.rejected += [RejectedClosure(finder.to_lidar(loop), reason) for loop in contradicting]
        upright_loops = self._new_loops(allowed, self._returned)
        for loop in upright_loops:
            finder.close_loop(loop.query, loop.match)
        loops = list(map(finder.to_lidar, upright_loops))
        self.loops += loops
        return loops

    def undecided(self) -> list[RejectedClosure]:
        """Rejections of the pairs that still wait for their neighbours, for the end of a stream."""
        return self._reject(self._waiting)

    def _new_loops(self, pairs: Sequence[Pair], known_queries: set[int]) -> list[LoopClosure]:
        """Probable loops, given their neighbours, whose queries are new. Adds their queries to `known_queries`."""
        finder = self.finder
        loops = probable_loops(pairs, self.model, finder.motion.path, drift=finder.present_drift, config=self.config)
        new_loops = [loop for loop in loops if loop is not None and loop.query not in known_queries]
        known_queries |= {loop.query for loop in new_loops}
        return new_loops

    def _is_allowed(self, pair: Pair) -> bool:
        """Whether the motion allows the pose of a pair."""
        return bool(pair.evidence.deviation <= self.finder.present_drift.max_deviation)

    def _reject(self, pairs: Sequence[Pair]) -> list[RejectedClosure]:
        """Rejections, with reasons, of the pairs that were not returned although the motion allows them."""
        min_probability = self.config.min_probability
        return [
            RejectedClosure(self.finder.to_lidar(pair.loop), rejection_reason(pair, self.model, min_probability))
            for pair in pairs
            if pair.loop.query not in self._returned and self._is_allowed(pair)
        ]
