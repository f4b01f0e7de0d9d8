"""Motion of the sensor from frame to frame, from odometry or by registration of images with a reference frame.

Over some hundred metres, the motion is accurate enough to tell which scans show other places. If the images show the
position in one direction only, as in a tunnel, the sensor is assumed to move on as before, and the drift grows fast. If
they show no position, a new segment begins. Only ratios of times count, so a faster drive has the same motion.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.growing import GrowingArray
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.registration.bev_search import NO_PRIOR
from sglpr_jax.se3 import inverse, planar_pose, transform, travelled, yaw_of

MOST_STEPS = 3.0
"""Maximum time step, as a multiple of the previous one, for which a pose is extrapolated. A longer one is a gap."""
EQUAL = 0.99
"""Minimum correlation of equal images. They show that the sensor stands, even between plain walls."""
STANDING_M = 0.05
"""Maximum length of a step of a sensor that stands, in metres."""
TURN_DEG = 90.0
"""Maximum rotation from the expected pose, in degrees. A pose beyond it drifts like a guess, because rows of cars look
alike from both ends."""
GAP_M = 1000.0
"""Travelled distance assumed for an unknown motion, as after a restart, in metres."""
UNKNOWN_M = 1e6
"""Length of measured path with as much drift as an unknown motion, in metres: the sensor may be anywhere."""
MIN_CORRELATION = 0.15
"""Minimum correlation of the two images of an accepted registration."""
MAX_ALONG_M = 0.25
"""Maximum standard deviation of the pose along its least certain direction, in metres. Above it, the images do not
show how far the sensor moved, as between walls."""
MIN_EXPECTED = 0.8
"""Minimum correlation near the expected pose, divided by that at the best pose, for the sensor to be assumed to move on
as before. It counts if the best pose is less certain than `MAX_ALONG_M`."""
MAX_SECOND, MAX_SECOND_OF_JUMP, MAX_SECOND_EXPECTED = 0.8, 0.6, 0.95
"""Maximum second-peak ratio of an accepted pose: in general, far from the expected pose, and at the expected pose."""
EXPECTED_M, EXPECTED_DEG = 1.0, 5.0
"""Maximum distance and rotation from the expected pose of a pose that is at it, in metres and degrees."""
MAX_JUMP, MAX_JUMP_M = 2.0, 1.0
"""A pose is far from the expected one beyond `MAX_JUMP` times the last step, plus `MAX_JUMP_M` metres."""
MAX_COASTING = 3
"""Maximum number of consecutive frames whose registration is rejected and whose pose is extrapolated."""
REFERENCE_M, REFERENCE_DEG = 3.0, 20.0
"""Distance or angle from the reference beyond which a frame becomes the next reference, in metres and degrees."""
GUESS_FACTOR = 300.0
"""Length of measured path with as much drift as one metre of guessed motion, in metres."""
AMBIGUOUS_SHARE = 0.25
"""Share of a step that counts as guessed if its registration is ambiguous."""
M_PER_UNCERTAIN_M = 100.0
"""Length of measured path with as much drift as one metre of standard deviation along a wall, in metres."""
LEAST_STEP_M, UNKNOWN_STEP_M = 0.5, 12.0
"""Minimum length of a guessed step, and its length if the speed was never known, in metres."""
FIELDS = [("time", "f8"), ("segment", "i8"), ("travelled", "f8"), ("guessed_m", "f8")]
"""Fields of the table of frames, which holds all but the pose of each frame."""


class BevOdometry:
    """Motion of the sensor: poses of all added frames, in order, with travelled distance and drift."""

    def __init__(self):
        self.reference = 0
        """Frame with which the next image is registered."""
        self.path = DrivenPath()
        """Planar poses of all added frames by their images or, with odometry, its gravity-aligned poses."""
        self._table = GrowingArray(np.empty(0, FIELDS))
        self._coasted = 0
        """Number of extrapolated frames since the last registered one."""
        self._m_per_s: float | None = None
        """Last known forward speed, in metres per second. None while it was never known."""
        self._top_m_per_s = 0.0
        """Highest speed between two registered frames, in metres per second."""

    def __len__(self) -> int:
        return len(self.path)

    @classmethod
    def of(cls, poses: Float[np.ndarray, "n 4 4"]) -> "BevOdometry":
        """Motion along known poses, such as those of the places of a map."""
        motion, table = cls(), np.zeros(len(poses), FIELDS)
        table["travelled"] = travelled(poses) if len(poses) else 0.0
        motion._table.extend(table)
        motion.path.extend(poses)
        return motion

    @classmethod
    def joined(cls, motions: "Sequence[BevOdometry]") -> "BevOdometry":
        """Motion of several recordings, one after the other, in level worlds. Poses between two of them are unknown."""
        joined = cls()
        for motion in motions:
            table = motion._table.rows.copy()
            if len(joined):
                last = joined._table.rows[-1]
                table["segment"] += last["segment"] + 1
                table["travelled"] += last["travelled"] + GAP_M
                table["guessed_m"] += last["guessed_m"] + UNKNOWN_M
            joined._table.extend(table)
            joined.path.extend(motion.path.leveled(np.arange(len(motion))), table["guessed_m"])
        return joined

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Pose of each frame in the frame of the first one. Across segments it is a guess."""
        return self.path.poses

    @property
    def segments(self) -> Int[np.ndarray, " n"]:
        """Number of the segment of each frame. Relative poses are known within a segment."""
        return self._table.rows["segment"]

    @property
    def travelled(self) -> Float[np.ndarray, " n"]:
        """Travelled distance at each frame, in metres: the sum of steps between references and of guesses."""
        return self._table.rows["travelled"]

    @property
    def guessed_m(self) -> Float[np.ndarray, " n"]:
        """Length of measured path with as much drift as all guesses up to each frame, in metres."""
        return self._table.rows["guessed_m"]

    @property
    def _times(self) -> Float[np.ndarray, " n"]:
        return self._table.rows["time"]

    @property
    def nbytes(self) -> int:
        """Number of bytes that the arrays hold."""
        return self.path.nbytes + self._table.nbytes

    def add(
        self,
        time: float,
        *,
        pose: Float[np.ndarray, "4 4"] | None = None,
        link: BevRegistration | None = None,
        continues: bool = True,
    ) -> None:
        """Add a frame by its gravity-aligned `pose` from odometry or by the registration `link` with the reference.

        An ambiguous registration drifts like a guess. Without pose and registration, the pose is extrapolated for up to
        `MAX_COASTING` frames, then guessed. With `continues=False`, the motion since the last frame is unknown.
        """
        if len(self) and not continues:
            self._add_after_restart(time, pose)
            return
        extrapolates, is_ambiguous, along_m = False, False, math.inf
        if pose is None and link is not None:
            prior = self.prior(time, self.reference)
            is_surprising = link.angle_to(prior[2]) > np.radians(TURN_DEG) or self._steps(time) > MOST_STEPS
            is_ambiguous = is_surprising or not self.is_trusted(link, prior)
            along_m = float(link.along_m) if self.is_ridge(link) else math.inf
            pose = self.poses[self.reference] @ link.match_from_query
        elif pose is None and self._coasted < MAX_COASTING:
            pose, extrapolates = self.extrapolated(time), True
        self._coasted = self._coasted + 1 if extrapolates else 0
        if not len(self):
            self._append(time, np.eye(4) if pose is None else pose, segment=0, travelled=0.0, guessed_m=0.0)
        elif pose is None:
            self._add_guess(time)
        else:
            moved_m, rotation = self.moved(self.reference, pose)
            is_guess = extrapolates or is_ambiguous
            guessed_m = self.guessed_m[self.reference]
            if is_guess:
                after_guess_m = self._guessed_m_after(time, share=1.0 if extrapolates else AMBIGUOUS_SHARE)
                guessed_m = min(after_guess_m, self.guessed_m[-1] + M_PER_UNCERTAIN_M * along_m)
            travelled_m, segment = self.travelled[self.reference] + moved_m, int(self.segments[self.reference])
            seconds, step_m = time - self._times[-1], float(np.linalg.norm((pose - self.poses[-1])[:3, 3]))
            if not is_guess and seconds > 0:
                self._top_m_per_s = max(self._top_m_per_s, step_m / seconds)
            self._append(time, pose, segment=segment, travelled=travelled_m, guessed_m=guessed_m)
            is_near_reference = moved_m <= REFERENCE_M and rotation <= np.radians(REFERENCE_DEG)
            if is_near_reference and not is_guess:
                return  # the reference stays
        self.reference = len(self) - 1

    def prior(self, time: float, frame: int) -> Float[np.ndarray, " 3"]:
        """Expected x, y (metres) and yaw (radians) in an earlier frame, at constant velocity. `NO_PRIOR` if unknown."""
        expected = self.extrapolated(time)
        return NO_PRIOR if expected is None else planar_pose(inverse(self.poses[frame]) @ expected)

    def extrapolated(self, time: float) -> Float[np.ndarray, "4 4"] | None:
        """Pose at `time` at constant velocity, or None if the velocity is unknown or the last frame is too old."""
        frames, steps = self._last_known_step, self._steps(time)
        if frames is None or not 0 < steps <= MOST_STEPS:
            return None
        start, end = frames
        step = inverse(self.poses[start]) @ self.poses[end]
        return self.poses[-1] @ transform(steps * step[0, 3], steps * step[1, 3], steps * float(yaw_of(step)))

    def most_moved_m(self, time: float) -> float:
        """Distance from the last frame that the sensor could have at `time`, at its highest speed so far, in metres."""
        return self._top_m_per_s * (time - self._times[-1])

    def is_trusted(self, link: BevRegistration, prior: Float[np.ndarray, " 3"]) -> bool:
        """Whether a registration shows how the sensor moved: no other pose fits about as well.

        A registration far from the expected pose (`prior`) must be less ambiguous, and one at it may be more ambiguous.
        """
        limit = MAX_SECOND
        apart_m = float(np.hypot(link.x - prior[0], link.y - prior[1]))
        if apart_m > MAX_JUMP * self._last_step_m + MAX_JUMP_M:
            limit = MAX_SECOND_OF_JUMP
        elif apart_m <= EXPECTED_M and link.angle_to(prior[2]) <= np.radians(EXPECTED_DEG):
            limit = MAX_SECOND_EXPECTED
        return bool(link.correlation >= MIN_CORRELATION and link.peak_ratio <= limit) and not self.is_ridge(link)

    def is_ridge(self, link: BevRegistration) -> bool:
        """Whether the registered images show the position in one direction only, as between walls."""
        return bool(link.along_m > MAX_ALONG_M and link.correlation < EQUAL)

    def moved(self, frame: int, pose: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
        """Distance (metres) and absolute rotation (radians) from a frame to a pose."""
        motion = inverse(self.poses[frame]) @ pose
        return float(np.linalg.norm(motion[:3, 3])), abs(float(yaw_of(motion)))

    def _add_after_restart(self, time: float, pose: Float[np.ndarray, "4 4"] | None) -> None:
        """Add a frame in a new segment, at a pose by odometry that may have another origin, or at the last pose."""
        self._append(
            time,
            self.poses[-1] if pose is None else pose,
            segment=int(self.segments[-1]) + 1,
            travelled=self.travelled[-1] + GAP_M,
            guessed_m=self.guessed_m[-1] + UNKNOWN_M,
        )
        self._coasted, self._m_per_s, self.reference = 0, None, len(self) - 1

    def _add_guess(self, time: float) -> None:
        """Add a frame in a new segment. Its motion is a guess: straight on at the last known speed."""
        seconds = time - self._times[-1]
        if self._knows_last_step and self._times[-1] > self._times[-2]:
            step = inverse(self.poses[-2]) @ self.poses[-1]
            self._m_per_s = float(step[0, 3]) / (self._times[-1] - self._times[-2])
        self._append(
            time,
            self.poses[-1] @ transform((self._m_per_s or 0.0) * seconds, 0.0, 0.0),
            segment=int(self.segments[-1]) + 1,
            travelled=self.travelled[-1] + self._guessed_step_m(time),
            guessed_m=self._guessed_m_after(time),
        )

    def _append(
        self, time: float, pose: Float[np.ndarray, "4 4"], *, segment: int, travelled: float, guessed_m: float
    ) -> None:
        self.path.extend(pose[None], np.array([guessed_m]))
        self._table.append((time, segment, travelled, guessed_m))

    @property
    def _knows_last_step(self) -> bool:
        """Whether the last two frames are of one segment."""
        return len(self) > 1 and bool(self.segments[-1] == self.segments[-2])

    @property
    def _last_known_step(self) -> tuple[int, int] | None:
        """First and last frame, counted from the end (-1), of the last step with a known velocity. None without one.

        A step without motion may be a scan that was added twice, so the step before it is returned instead.
        """
        for end in (-1, -2):
            start = end - 1
            if len(self) < -start or self.segments[end] != self.segments[start]:
                return None
            moved_m = float(np.linalg.norm((self.poses[end] - self.poses[start])[:3, 3]))
            if self._times[end] > self._times[start] and (moved_m > STANDING_M or end == -2):
                return start, end
        return None

    def _steps(self, time: float) -> float:
        """Time since the last frame, as a multiple of the last known time step. 1 without a known step."""
        frames = self._last_known_step
        if frames is None:
            return 1.0
        start, end = frames
        return float((time - self._times[-1]) / (self._times[end] - self._times[start]))

    def _guessed_m_after(self, time: float, *, share: float = 1.0) -> float:
        """Value of `guessed_m` for the next frame, if this share of the motion since the last frame is a guess."""
        return self.guessed_m[-1] + share * GUESS_FACTOR * max(self._guessed_step_m(time), LEAST_STEP_M)

    def _guessed_step_m(self, time: float) -> float:
        """Length of a guessed step to the next frame, in metres: at the last known speed, or `UNKNOWN_STEP_M`."""
        if self._knows_last_step:
            return self._last_step_m * max(self._steps(time), 1.0)
        if self._m_per_s is not None:
            return abs(self._m_per_s) * (time - self._times[-1])
        return UNKNOWN_STEP_M

    @property
    def _last_step_m(self) -> float:
        """Length of the longer one of the last two steps within a segment, in metres. The last scan may have been added
        twice."""
        steps_m = np.linalg.norm(np.diff(self.poses[-3:, :3, 3], axis=0), axis=1)
        return float(steps_m[np.diff(self.segments[-3:]) == 0].max(initial=0.0))
