"""Motion of the sensor from frame to frame, from odometry or by registration of each image with a keyframe.

The test for repeating places needs to know which earlier scans resemble the query because they show the same place. The
motion is accurate enough for this purpose over some tens of metres. It does not replace odometry. Where the
surroundings do not show how the sensor moved, as in a tunnel, the motion is unknown and a new segment begins. Its pose
is extrapolated at the last known velocity, and its drift grows fast.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.config import MotionConfig
from sglpr_jax.loops.driven_path import DrivenPath
from sglpr_jax.loops.pose_search import Peak
from sglpr_jax.loops.transforms import inverse, transform, yaw_of

MOST_STEPS = 3.0
"""Maximum time step for which a pose is extrapolated, as a multiple of the previous time step."""
UNKNOWN_M = 1e6
"""Length of measured path with the same drift as an unknown motion, in metres: the sensor may be anywhere."""
NUMBERS = [("time", "f8"), ("segment", "i8"), ("travelled", "f8"), ("guessed_m", "f8"), ("clock", "f8")]
"""Numbers of a frame beside its pose."""


class Motion:
    """Planar poses of all added frames, in order."""

    def __init__(self, config: MotionConfig = MotionConfig()):
        self.config = config
        self.keyframe = 0
        self.path = DrivenPath()
        """Planar poses of all added frames or, with odometry, its gravity-aligned poses."""
        self._numbers = GrowingArray(np.empty(0, NUMBERS))
        self._coasted = 0
        self._m_per_s = 0.0
        """Last known forward speed, in metres per second."""

    def __len__(self) -> int:
        return len(self.path)

    @classmethod
    def joined(cls, motions: "Sequence[Motion]") -> "Motion":
        """Motion of several recordings, one after the other. Poses between two recordings are unknown."""
        found = cls()
        for one in motions:
            numbers, last = one._numbers.rows.copy(), found._numbers.rows[-1:]
            for name in ("segment", "travelled", "guessed_m", "clock") if len(last) else ():
                numbers[name] += last[name] + (name == "segment")
            found._numbers.extend(numbers)
            found.path.extend(one.poses, numbers["guessed_m"])
        return found

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
        """Travelled distance at each frame, from keyframe to keyframe, in metres."""
        return self._numbers.rows["travelled"]

    @property
    def guessed_m(self) -> Float[np.ndarray, " n"]:
        """Length of measured path with the same drift as all guesses up to each frame, in metres."""
        return self._numbers.rows["guessed_m"]

    @property
    def clock(self) -> Float[np.ndarray, " n"]:
        """Time at each frame without the time in which the sensor stood still, in seconds."""
        return self._numbers.rows["clock"]

    @property
    def nbytes(self) -> int:
        """Number of bytes that the arrays hold."""
        return self.path.nbytes + self._numbers.nbytes

    def add(
        self,
        time: float,
        *,
        pose: Float[np.ndarray, "4 4"] | None = None,
        link: Peak | None = None,
        continues: bool = True,
    ) -> None:
        """Add a frame at `time` (seconds), by its `pose` from odometry or its peak `link` over the keyframe.

        With `continues=False`, the motion since the last frame is unknown, as after a restart.
        """
        if len(self) and not continues:
            return self._begin(time, self.poses[-1] if pose is None else pose)
        key, coasts = self.keyframe, False
        if (
            pose is None
            and link is not None
            and self._is_trusted(link, expected=bool(np.isfinite(self.prior(time)).all()))
        ):
            pose = self.poses[key] @ transform(float(link.x), float(link.y), float(link.yaw))
        elif pose is None and self._coasted < self.config.max_coasting:
            pose, coasts = self._expected(time), True
        self._coasted = self._coasted + 1 if coasts else 0
        if not len(self):
            self._append(time, np.eye(4) if pose is None else pose, segment=0, travelled=0.0, clock=0.0, guessed_m=0.0)
        elif pose is None:
            self._guess(time)
        else:
            moved, rotation = self.moved(key, pose)
            clock = self.clock[key] + min(time - self._times[key], self.config.standing_s)
            travelled = self.travelled[key] + moved
            guessed_m = self._drifted_m(time) if coasts else self.guessed_m[key]
            self._append(
                time, pose, segment=int(self.segments[key]), travelled=travelled, clock=clock, guessed_m=guessed_m
            )
            if moved <= self.config.keyframe_m and rotation <= np.radians(self.config.keyframe_deg) and not coasts:
                return
        self.keyframe = len(self) - 1

    def link(self, anywhere: Peak, expected: Peak) -> Peak:
        """Choose between the best peak over the keyframe, if it is accepted, and the best peak near the prior."""
        return anywhere if self._is_trusted(anywhere, expected=False) else expected

    def prior(self, time: float) -> Float[np.ndarray, " 3"]:
        """Expected x, y and yaw in the frame of the keyframe, at constant velocity. NaN if unknown."""
        expected = self._expected(time)
        if expected is None:
            return np.full(3, np.nan)
        moved = inverse(self.poses[self.keyframe]) @ expected
        return np.array([moved[0, 3], moved[1, 3], yaw_of(moved)])

    def _expected(self, time: float) -> Float[np.ndarray, "4 4"] | None:
        if len(self) < 2 or self.segments[-1] != self.segments[-2] or self._times[-1] <= self._times[-2]:
            return None
        steps = (time - self._times[-1]) / (self._times[-1] - self._times[-2])
        if not 0 < steps <= MOST_STEPS:
            return None
        last = inverse(self.poses[-2]) @ self.poses[-1]
        return self.poses[-1] @ transform(steps * last[0, 3], steps * last[1, 3], steps * float(yaw_of(last)))

    def _guess(self, time: float) -> None:
        """Add a frame whose motion is unknown."""
        seconds = time - self._times[-1]
        if len(self) > 1 and self.segments[-1] == self.segments[-2] and self._times[-1] > self._times[-2]:
            step = inverse(self.poses[-2]) @ self.poses[-1]
            self._m_per_s = float(step[0, 3]) / (self._times[-1] - self._times[-2])
        self._append(
            time,
            self.poses[-1] @ transform(self._m_per_s * seconds, 0.0, 0.0),
            segment=int(self.segments[-1]) + 1,
            travelled=self.travelled[-1],
            clock=self.clock[-1] + seconds,
            guessed_m=self._drifted_m(time),
        )

    def _begin(self, time: float, pose: Float[np.ndarray, "4 4"]) -> None:
        """Add the first frame after an unknown motion."""
        clock = self.clock[-1] + time - self._times[-1]
        segment, guessed_m = int(self.segments[-1]) + 1, self.guessed_m[-1] + UNKNOWN_M
        self._append(time, pose, segment=segment, travelled=self.travelled[-1], clock=clock, guessed_m=guessed_m)
        self._coasted, self._m_per_s, self.keyframe = 0, 0.0, len(self) - 1

    def _drifted_m(self, time: float) -> float:
        """Next value of `guessed_m`, if the motion since the last frame is a guess."""
        return self.guessed_m[-1] + self.config.guess_m_per_s * (time - self._times[-1])

    def _append(
        self,
        time: float,
        pose: Float[np.ndarray, "4 4"],
        *,
        segment: int,
        travelled: float,
        clock: float,
        guessed_m: float,
    ) -> None:
        self.path.add(pose, guessed_m=guessed_m)
        self._numbers.append((time, segment, travelled, guessed_m, clock))

    @property
    def _times(self) -> Float[np.ndarray, " n"]:
        return self._numbers.rows["time"]

    def from_frame(self, frame: int, rows: np.ndarray) -> tuple[Float[np.ndarray, "k 4 4"], Bool[np.ndarray, " k"]]:
        """Poses of `frame` in the frames of `rows`, and whether each is known."""
        return inverse(self.poses[rows]) @ self.poses[frame], self.same(frame, rows)

    def about(self, frame: int, seconds: float, rows: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether each of `rows` is less than `seconds` before or after `frame`, without standing time."""
        return np.abs(self.clock[rows] - self.clock[frame]) < seconds

    def same(self, frame: int, rows: np.ndarray) -> Bool[np.ndarray, " k"]:
        """For each of `rows`, whether its pose relative to `frame` is known: one bool a row."""
        return self.segments[rows] == self.segments[frame]

    def near_last(self, travelled_m: float, rows: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether each of `rows` is known to be less than `travelled_m` (metres) before the last frame."""
        if not len(self):
            return np.zeros(0, bool)
        return self.same(-1, rows) & (self.travelled[-1] - self.travelled[rows] < travelled_m)

    def _is_trusted(self, link: Peak, *, expected: bool) -> bool:
        best, config = float(link.correlation), self.config
        most = config.max_second_expected if expected else config.max_second
        fits = best >= config.min_correlation and float(link.second) <= most * best
        return fits and float(link.ridge) <= config.max_ridge * best

    def moved(self, frame: int, pose: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
        """Distance (metres) and rotation (radians) from a frame to a pose."""
        moved = inverse(self.poses[frame]) @ pose
        return float(np.linalg.norm(moved[:3, 3])), abs(float(yaw_of(moved)))
