"""Loop detector for a stream of scans."""

import dataclasses
import datetime
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.special import expit, logit

from sglpr_jax.data.choices import TimeUnit
from sglpr_jax.data.record import Record
from sglpr_jax.data.times import PROOF, doubt, unit_change
from sglpr_jax.fields import check_value
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.consistency import agree_along
from sglpr_jax.loops.drift import deviations_along
from sglpr_jax.loops.given import DATES, given_pose, given_record, given_time
from sglpr_jax.loops.loop import Loop, Reason, Rejected, planar_loop
from sglpr_jax.loops.planar import frames_of
from sglpr_jax.loops.probability import LoopModel, default_model
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.sequence import added_log_odds, agree_in_motion, agree_in_order
from sglpr_jax.models.params import Params

RECENT = 8
"""Number of latest times that are compared with a new one."""


class LoopDetector:
    """Finds loop closures in a stream of scans or images, with or without times and odometry.

    `LoopModel` computes the probability of a pair from descriptors and images. The sequential test (`loops.sequence`)
    adds the evidence of neighbouring frames. At least one neighbour must agree. Loops that contradict the odometry are
    rejected. Without odometry, loops that contradict the motion estimated from the images are rejected. The first loop
    of a revisit is returned at least one frame late, together with others.

    Example:
      detector = LoopDetector(sglpr_jax.load("sglpr"))
      for i in range(len(recording)):
          for loop in detector.add(recording.points(i), time=recording.times[i]):
              print(loop.query, loop.match, loop.match_from_query, loop.probability)
    """

    def __init__(
        self,
        params: Params,
        *,
        model: LoopModel | None = None,
        config: DetectorConfig = DetectorConfig(),
        time_unit: TimeUnit = "auto",
    ):
        """Create a detector without frames.

        Arguments:
          params: Weights of the model that describes the scans.
          model: Model of the probabilities, by default the one shipped for the weights.
          config: Thresholds.
          time_unit: Unit of the times of `add`. "auto" expects seconds and rejects times whose first steps contradict
            this. Dates and time differences of numpy and datetime have a unit of their own.
        """
        check_value(time_unit, TimeUnit, "time_unit")
        self.time_unit: TimeUnit = time_unit
        self.finder = CandidateFinder(
            params,
            config=config.candidates,
            verification=config.verification,
            drift=config.drift,
            keyframe_m=config.keyframe_m,
            max_places=config.max_places,
        )
        self.model = default_model(self.finder.index.weights_hash) if model is None else model
        self.config = config
        self.candidates: list[Candidate] = []
        """All compared pairs or, with `max_places`, that many of the last ones."""
        self.loops: list[Loop] = []
        """All returned loops."""
        self.supported: list[Loop] = []
        """Loops that pass the sequential test and the drift test, even if other loops contradict them."""
        self.rejected: list[Rejected] = []
        """Pairs that looked like loops, each with the reason for its rejection."""
        self.by_scans: set[int] = set()
        """Frames whose scans alone support a loop. If most contradict the odometry, the odometry may be wrong."""
        self._waiting: list[Loop] = []

    def __len__(self) -> int:
        """Number of added frames."""
        return len(self.finder)

    @property
    def nbytes(self) -> int:
        """Number of bytes of all frames. The results (`loops`, `supported`, `rejected`, `candidates`) are not counted,
        nor are the spectra of the last compared scans (13 MB at most).

        With `max_places`, only poses and times still grow: 305 bytes a frame, and up to as much in spare capacity.
        """
        return self.finder.nbytes

    def add(
        self,
        scan: Record | ArrayLike,
        *,
        time: float | np.datetime64 | np.timedelta64 | datetime.datetime | datetime.timedelta | None = None,
        odometry: ArrayLike | None = None,
        continues: bool = True,
    ) -> list[Loop]:
        """Add the next frame. Returns the loops that it closes or confirms, of this and of the last few frames.

        Arguments:
          scan: A record (with the mounting of its sensor), points (n, 3) in metres, or an image (h, w) from
            `density_bev`.
          time: Time of the scan in `time_unit`, or a date.
          odometry: Pose of the LiDAR in a fixed frame. It may drift.
          continues: False if the motion since the last frame is unknown, for example after a restart. The odometry may
            then begin in another frame.

        Raises:
          ValueError: If a value has another shape, if times decrease or are not in seconds, or if only some frames have
            a time or odometry.
          TypeError: If a value is not an array of numbers, for instance a path.
        """
        record, pose = given_record(scan), given_pose(odometry)
        seconds = self._seconds(time)
        return self.add_seen(self.finder.seen(record), time=seconds, odometry=pose, continues=continues)

    def _seconds(self, time: Any) -> float | None:
        """Convert a time to seconds. Raises ValueError as soon as the steps show another unit than before or, with
        "auto", than seconds."""
        seconds, before = given_time(time, unit=self.time_unit), self.finder.times
        if seconds is None or isinstance(time, DATES):
            return seconds
        clock = np.array([seconds]) if before is None else np.append(before[-RECENT:], seconds)
        if changed := unit_change(clock):
            raise ValueError(f"frame {len(self)}: expected times in the unit of those before, found {changed.found}")
        if self.time_unit == "auto" and len(self) <= PROOF and (found := doubt(clock)):
            raise ValueError(
                f"frame {len(self)}: expected times in seconds, found {found}; state the unit with LoopDetector(..., "
                "time_unit=...), or leave the times out"
            )
        return seconds

    def add_seen(
        self,
        seen: Seen | None,
        *,
        time: float | None = None,
        odometry: Float[np.ndarray, "4 4"] | None = None,
        compared: Compared | None = None,
        continues: bool = True,
    ) -> list[Loop]:
        """Add a frame that is already described, and return loops as `add` does.

        Arguments:
          seen: Descriptor and image, or None for a scan that cannot be read.
          time: Time of the scan, in seconds.
          odometry: Pose of the LiDAR in a fixed frame.
          compared: Comparisons of an earlier run (`loops.unfinished`).
          continues: See `add`.
        """
        candidates = self.finder.add_seen(seen, time=time, odometry=odometry, compared=compared, continues=continues)
        self.candidates += candidates
        if self.config.max_places is not None:
            del self.candidates[: -self.config.max_places]
        for one in candidates:
            self._consider(one)
        first = len(self) - 1 - self.config.sequence.frames
        returned = {loop.query for loop in self.loops[-2 * self.config.sequence.frames :]}
        for loop in self._waiting:
            if loop.query < first and loop.query not in returned and loop.probability >= self.config.min_probability:
                self._reject([loop], "too few neighbours")
        self._waiting = [loop for loop in self._waiting if loop.query >= first]
        new = self._confirmed() if self._waiting else []
        self.loops += new
        for loop in new:
            self.finder.stored.close_loop(loop.query, loop.match)
        return new

    def _consider(self, one: Candidate) -> None:
        """Keep a candidate until its neighbours are known, unless it is improbable."""
        log_odds, least = float(self.model.log_odds(one.evidence)), self.config.sequence.least_probability
        loop = self._loop(one, float(expit(log_odds)))
        if log_odds >= logit(min(least, self.config.min_probability)):
            self._waiting.append(loop)
        elif self.model.but_for_repetition(one.evidence) >= logit(self.config.min_probability):
            self._reject([loop], "repeats")

    def _reject(self, loops: Sequence[Loop], reason: Reason) -> None:
        known = {one.loop.query for one in self.rejected[-2 * self.config.sequence.frames :]}
        self.rejected += [Rejected(loop, reason) for loop in loops if loop.query not in known]

    def _confirmed(self) -> list[Loop]:
        """Loops of the last frames that pass the sequential test, the drift test and, with odometry, other loops."""
        rules, motion = self.config.sequence, self.finder.motion
        self.by_scans |= {loop.query for loop in self._accepted(agree_in_order(self._waiting, config=rules))}
        found = self._accepted(agree_in_motion(self._waiting, motion, self.finder.mountings, config=rules))
        recent = 2 * rules.frames
        done = {loop.query for loop in self.loops[-recent:]}
        found = self._within_drift([loop for loop in found if loop.query not in done])
        known = {loop.query for loop in self.supported[-recent:]}
        self.supported += [loop for loop in found if loop.query not in known]
        return [loop for loop in found if self._agrees(loop)]

    def _accepted(self, agreeing: Bool[np.ndarray, "n n"]) -> list[Loop]:
        """Loops of the last frames that are probable enough, given the loops that agree with them."""
        rules = self.config.sequence
        own = logit(np.array([loop.probability for loop in self._waiting]))
        log_odds = added_log_odds(self._waiting, own, agreeing, self.finder.motion, config=rules)
        enough = (agreeing.sum(axis=1) >= rules.support) & (log_odds >= logit(self.config.min_probability))
        return [
            dataclasses.replace(loop, probability=float(expit(value)))
            for loop, value, fits in zip(self._waiting, log_odds, enough, strict=True)
            if fits
        ]

    def _within_drift(self, loops: list[Loop]) -> list[Loop]:
        """Loops within the drift of the odometry or, without odometry, of the motion. The others are rejected."""
        if not loops:
            return []
        drift, reason = self.config.drift, "contradicts the odometry"
        if not self.finder.has_odometry:
            drift, reason = self.config.motion_drift, "contradicts the motion"
        apart = deviations_along(self.finder.motion.path, loops, drift=drift, mounting=self.finder.mountings)
        fits = apart <= drift.max_deviation
        if self.finder.has_odometry:  # it does not say where its parts are relative to each other
            query, match = frames_of(loops)
            segments = self.finder.motion.segments
            fits = fits | (segments[query] != segments[match])
        self._reject([loop for loop, fit in zip(loops, fits, strict=True) if not fit], reason)
        return [loop for loop, fit in zip(loops, fits, strict=True) if fit]

    @property
    def _rules(self) -> dict[str, Any]:
        config = self.config
        return {"mounting": self.finder.mountings, "drift": config.drift, "config": config.consistency}

    def _agrees(self, loop: Loop) -> bool:
        """Whether a loop is consistent with at least half of the loops nearby. True without odometry.

        Loops that were not returned count, too. Otherwise a few early wrong loops would block all true ones.
        """
        path = self.finder.motion.path
        if not self.finder.has_odometry:
            return True
        about = self._near(loop, path.travelled)
        if not about:
            return True
        return bool(agree_along(path, [loop], about, **self._rules).mean() >= 0.5)

    def _near(self, loop: Loop, way: Float[np.ndarray, " n"]) -> list[Loop]:
        """Other loops within `near_m` of a loop, by travelled distance `way`. Much earlier loops are not looked at."""
        near = []
        for other in reversed(self.supported):
            # Loops before this one in the list have queries up to `frames` later, because neighbours confirm a loop.
            last = min(other.query + self.config.sequence.frames, len(way) - 1)
            if way[loop.query] - way[last] > self.config.near_m:
                break
            apart = abs(way[other.query] - way[loop.query]) + abs(way[other.match] - way[loop.match])
            if other.query != loop.query and apart <= self.config.near_m:
                near.append(other)
        return near

    def _loop(self, one: Candidate, probability: float) -> Loop:
        each = self.finder.mountings
        mountings = {"query_mounting": each[one.query], "match_mounting": each[one.match]}
        return planar_loop(one.query, one.match, one.alignment, probability=probability, **mountings)
