"""Motion of the sensor from frame to frame, from odometry or by registration of each image with a keyframe.

It is accurate enough over some hundred metres to tell which scans show other places. Where the surroundings show only
the position across a direction, as in a tunnel, the sensor is assumed to move on as before, and the drift grows fast.
Where they show nothing, a new segment begins. Only ratios of times count, so a faster drive has the same motion.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.growing import GrowingArray
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import inverse, planar_pose, transform, travelled, yaw_of

MOST_STEPS = 3.0
"""Maximum time step, as a multiple of the previous one, for which a pose is extrapolated. A longer one is a gap."""
EQUAL = 0.99
"""Correlation of equal images. Between plain walls, too, they show that the sensor stands."""
STANDING_M = 0.05
"""Maximum length of a step of a sensor that stands, in metres."""
TURN_DEG = 90.0
"""Maximum rotation from the expected pose, in degrees. Beyond it, as after a gap, a pose drifts like a guess, because
rows of cars look alike from both ends."""
GAP_M = 1000.0
"""Travelled distance that counts for an unknown motion, as after a restart, in metres."""
UNKNOWN_M = 1e6
"""Length of measured path with the same drift as an unknown motion, in metres: the sensor may be anywhere."""
MIN_CORRELATION = 0.15
"""Minimum correlation of the two images of an accepted registration."""
MAX_ALONG_M = 0.25
"""Maximum standard deviation of the pose along its least certain direction, in metres. Above it, the images do not
show how far the sensor moved, as between walls."""
MIN_EXPECTED = 0.8
"""Minimum correlation near the expected pose, divided by that at the best pose, if the best pose is less certain than
`MAX_ALONG_M`. Above it, the sensor is assumed to move on as before."""
MAX_SECOND, MAX_SECOND_OF_JUMP, MAX_SECOND_EXPECTED = 0.8, 0.6, 0.95
"""Maximum second-peak ratio, that of a pose far from the expected one, and that of the expected pose."""
EXPECTED_M, EXPECTED_DEG = 1.0, 5.0
"""Maximum distance of a pose from the expected one, in metres and degrees."""
MAX_JUMP = 2.0
"""Distance from the expected pose, as a multiple of the last step, beyond which a pose is far from it."""
MAX_COASTING = 3
"""Maximum number of consecutive frames whose registration is rejected and whose pose is extrapolated."""
KEYFRAME_M, KEYFRAME_DEG = 3.0, 20.0
"""Distance or angle from the keyframe beyond which a frame becomes the next keyframe, in metres and degrees."""
GUESS_FACTOR = 300.0
"""Length of measured path with the same drift as one metre of guessed motion, in metres."""
AMBIGUOUS_SHARE = 0.25
"""Share of a step that counts as guessed if its link is ambiguous."""
M_PER_UNCERTAIN_M = 100.0
"""Length of measured path with the same drift as one metre of uncertainty along a wall, in metres."""
LEAST_STEP_M, UNKNOWN_STEP_M = 0.5, 12.0
"""Minimum length of a guessed step, and its length if the speed was never known, in metres."""
NUMBERS = [("time", "f8"), ("segment", "i8"), ("travelled", "f8"), ("guessed_m", "f8")]
"""Numbers of a frame beside its pose."""


class BevOdometry:
    """Planar poses of all added frames, in order."""

    def __init__(self):
        self.keyframe = 0
        """Frame in whose frame the next link is expressed."""
        self.path = DrivenPath()
        """Planar poses of all added frames or, with odometry, its gravity-aligned poses."""
        self._numbers = GrowingArray(np.empty(0, NUMBERS))
        self._coasted = 0
        """Number of extrapolated frames since the last registered one."""
        self._m_per_s: float | None = None
        """Last known forward speed, in metres per second. None while it was never known."""

    def __len__(self) -> int:
        return len(self.path)

    @classmethod
    def of(cls, poses: Float[np.ndarray, "n 4 4"]) -> "BevOdometry":
        """Motion along known poses, such as those of the places of a map."""
        motion, numbers = cls(), np.zeros(len(poses), NUMBERS)
        numbers["travelled"] = travelled(poses) if len(poses) else 0.0
        motion._numbers.extend(numbers)
        motion.path.extend(poses, np.zeros(len(poses)))
        return motion

    @classmethod
    def joined(cls, motions: "Sequence[BevOdometry]") -> "BevOdometry":
        """Motion of several recordings, one after the other, in level worlds. Poses between two of them are unknown."""
        joined = cls()
        for motion in motions:
            numbers = motion._numbers.rows.copy()
            if len(joined):
                last = joined._numbers.rows[-1]
                numbers["segment"] += last["segment"] + 1
                numbers["travelled"] += last["travelled"] + GAP_M
                numbers["guessed_m"] += last["guessed_m"] + UNKNOWN_M
            joined._numbers.extend(numbers)
            joined.path.extend(motion.path.leveled(np.arange(len(motion))), numbers["guessed_m"])
        return joined

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Pose of each frame in the frame of the first one. Across segments it is a guess."""
        return self.path.poses

    @property
    def segments(self) -> Int[np.ndarray, " n"]:
        """Segment of each frame. Relative poses are known within a segment."""
        return self._numbers.rows["segment"]

    @property
    def travelled(self) -> Float[np.ndarray, " n"]:
        """Travelled distance at each frame, from keyframe to keyframe and with the guessed motion, in metres."""
        return self._numbers.rows["travelled"]

    @property
    def guessed_m(self) -> Float[np.ndarray, " n"]:
        """Length of measured path with the same drift as all guesses up to each frame, in metres."""
        return self._numbers.rows["guessed_m"]

    @property
    def _times(self) -> Float[np.ndarray, " n"]:
        return self._numbers.rows["time"]

    @property
    def nbytes(self) -> int:
        """Number of bytes that the arrays hold."""
        return self.path.nbytes + self._numbers.nbytes

    def add(
        self,
        time: float,
        *,
        pose: Float[np.ndarray, "4 4"] | None = None,
        link: BevRegistration | None = None,
        continues: bool = True,
    ) -> None:
        """Add a frame at `time`, by its `pose` from odometry or its `link` with the keyframe.

        An ambiguous link drifts like a guess. With `continues=False`, the motion since the last frame is unknown.
        """
        if len(self) and not continues:
            self._add_after_restart(time, pose)
            return
        extrapolates, is_ambiguous, along_m = False, False, math.inf
        if pose is None and link is not None:
            prior = self.prior(time, self.keyframe)
            is_surprising = link.angle_to(prior[2]) > np.radians(TURN_DEG) or self._steps(time) > MOST_STEPS
            is_ambiguous = is_surprising or not self.is_trusted(link, prior)
            along_m = float(link.along_m) if self.is_ridge(link) else math.inf
            pose = self.poses[self.keyframe] @ transform(float(link.x), float(link.y), float(link.yaw))
        elif pose is None and self._coasted < MAX_COASTING:
            pose, extrapolates = self._extrapolated(time), True
        self._coasted = self._coasted + 1 if extrapolates else 0
        if not len(self):
            self._append(time, np.eye(4) if pose is None else pose, segment=0, travelled=0.0, guessed_m=0.0)
        elif pose is None:
            self._add_guess(time)
        else:
            moved_m, rotation = self.moved(self.keyframe, pose)
            guessed_m, is_guess = self.guessed_m[self.keyframe], extrapolates or is_ambiguous
            if is_guess:
                drifted_m = self._drifted_m(time, share=1.0 if extrapolates else AMBIGUOUS_SHARE)
                guessed_m = min(drifted_m, self.guessed_m[-1] + M_PER_UNCERTAIN_M * along_m)
            travelled_m, segment = self.travelled[self.keyframe] + moved_m, int(self.segments[self.keyframe])
            self._append(time, pose, segment=segment, travelled=travelled_m, guessed_m=guessed_m)
            if not (is_guess or moved_m > KEYFRAME_M or rotation > np.radians(KEYFRAME_DEG)):
                return
        self.keyframe = len(self) - 1

    def prior(self, time: float, frame: int) -> Float[np.ndarray, " 3"]:
        """Expected x, y (metres) and yaw (radians) in an earlier frame, at constant velocity. NaN if unknown."""
        expected = self._extrapolated(time)
        return np.full(3, np.nan) if expected is None else planar_pose(inverse(self.poses[frame]) @ expected)

    def same(self, frame: int, rows: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether the pose of each of `rows` relative to `frame` is known."""
        return self.segments[rows] == self.segments[frame]

    def is_trusted(self, link: BevRegistration, prior: Float[np.ndarray, " 3"]) -> bool:
        """Whether a link shows how the sensor moved: no other pose fits about as well.

        A link far from the prior has to be less ambiguous, and one at the prior may be more ambiguous.
        """
        limit, apart_m = MAX_SECOND, float(np.hypot(link.x - prior[0], link.y - prior[1]))
        if apart_m > MAX_JUMP * self._last_step_m + 1.0:
            limit = MAX_SECOND_OF_JUMP
        elif apart_m <= EXPECTED_M and link.angle_to(prior[2]) <= np.radians(EXPECTED_DEG):
            limit = MAX_SECOND_EXPECTED
        return bool(link.correlation >= MIN_CORRELATION and link.second <= limit) and not self.is_ridge(link)

    def is_ridge(self, link: BevRegistration) -> bool:
        """Whether the images show the position across a direction only, as between walls."""
        return bool(link.along_m > MAX_ALONG_M and link.correlation < EQUAL)

    def moved(self, frame: int, pose: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
        """Distance (metres) and rotation (radians) from a frame to a pose."""
        motion = inverse(self.poses[frame]) @ pose
        return float(np.linalg.norm(motion[:3, 3])), abs(float(yaw_of(motion)))

    def _add_after_restart(self, time: float, pose: Float[np.ndarray, "4 4"] | None) -> None:
        """Add a frame whose distance from the last one is unknown, by odometry that may begin in another frame."""
        self._append(
            time,
            self.poses[-1] if pose is None else pose,
            segment=int(self.segments[-1]) + 1,
            travelled=self.travelled[-1] + GAP_M,
            guessed_m=self.guessed_m[-1] + UNKNOWN_M,
        )
        self._coasted, self._m_per_s, self.keyframe = 0, None, len(self) - 1

    def _add_guess(self, time: float) -> None:
        """Add a frame whose motion is a guess: straight on at the last known speed. It begins a new segment."""
        seconds = time - self._times[-1]
        if self._knows_last_step and self._times[-1] > self._times[-2]:
            step = inverse(self.poses[-2]) @ self.poses[-1]
            self._m_per_s = float(step[0, 3]) / (self._times[-1] - self._times[-2])
        self._append(
            time,
            self.poses[-1] @ transform((self._m_per_s or 0.0) * seconds, 0.0, 0.0),
            segment=int(self.segments[-1]) + 1,
            travelled=self.travelled[-1] + self._guessed_step_m(time),
            guessed_m=self._drifted_m(time),
        )

    def _append(
        self, time: float, pose: Float[np.ndarray, "4 4"], *, segment: int, travelled: float, guessed_m: float
    ) -> None:
        self.path.extend(pose[None], np.array([guessed_m]))
        self._numbers.append((time, segment, travelled, guessed_m))

    @property
    def _knows_last_step(self) -> bool:
        return len(self) > 1 and bool(self.segments[-1] == self.segments[-2])

    @property
    def _last_moving(self) -> tuple[int, int] | None:
        """Rows, from the end, of the last step with a known motion. A scan that was added twice makes no step."""
        for after in (-1, -2):
            before = after - 1
            if len(self) < -before or self.segments[after] != self.segments[before]:
                return None
            moved_m = float(np.linalg.norm((self.poses[after] - self.poses[before])[:3, 3]))
            if self._times[after] > self._times[before] and (moved_m > STANDING_M or after == -2):
                return before, after
        return None

    def _steps(self, time: float) -> float:
        """Time since the last frame, as a multiple of the last time step with a known motion. 1 without such a step."""
        rows = self._last_moving
        if rows is None:
            return 1.0
        return float((time - self._times[-1]) / (self._times[rows[1]] - self._times[rows[0]]))

    def _extrapolated(self, time: float) -> Float[np.ndarray, "4 4"] | None:
        """Pose at constant velocity, or None if the velocity is unknown or the last frame is too old."""
        rows, steps = self._last_moving, self._steps(time)
        if rows is None or not 0 < steps <= MOST_STEPS:
            return None
        step = inverse(self.poses[rows[0]]) @ self.poses[rows[1]]
        return self.poses[-1] @ transform(steps * step[0, 3], steps * step[1, 3], steps * float(yaw_of(step)))

    def _drifted_m(self, time: float, *, share: float = 1.0) -> float:
        """Next value of `guessed_m`, if this share of the motion since the last frame is a guess."""
        return self.guessed_m[-1] + share * GUESS_FACTOR * max(self._guessed_step_m(time), LEAST_STEP_M)

    def _guessed_step_m(self, time: float) -> float:
        """Length of the next step, if it is a guess, in metres."""
        if self._knows_last_step:
            return self._last_step_m * max(self._steps(time), 1.0)
        if self._m_per_s is not None:
            return abs(self._m_per_s) * (time - self._times[-1])
        return UNKNOWN_STEP_M

    @property
    def _last_step_m(self) -> float:
        """Length of the longer one of the last two steps, in metres. The last scan may have been added twice."""
        return float(np.linalg.norm(np.diff(self.poses[-3:, :3, 3], axis=0), axis=1).max(initial=0.0))
