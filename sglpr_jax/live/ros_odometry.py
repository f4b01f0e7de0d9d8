"""Poses of the LiDAR at the times of scans, from the odometry messages of a robot."""

import math
import threading
import time as clock
from collections import defaultdict, deque

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.ros_messages import (
    POSES,
    RosMessage,
    StampedPose,
    Track,
    read_transforms,
    static_transform,
    tracks_of_transforms,
)
from sglpr_jax.data.poses import pose_at
from sglpr_jax.live.data_types import Report
from sglpr_jax.live.odometry_input import FASTEST_M_PER_S, SLACK_M
from sglpr_jax.live.ros_encoding import TRANSFORMS, Received

ODOMETRY_TYPES = (*POSES, TRANSFORMS)
"""Types of messages with odometry."""
MAX_POSES = 2000
"""Number of poses that are kept for each frame: two seconds at 1 kHz."""
SILENCE_S = 1.0
"""Time without poses after which scans no longer wait for one, in seconds."""
MOUNTING_WAIT_S = 3.0
"""Time from the first pose for which the mounting of the LiDAR is awaited on /tf_static, in seconds."""
RESET_S, PAUSE_S = 1.0, 2.0
"""Step back and step ahead in the times of poses, in seconds, beyond which the odometry has restarted."""
FASTEST_DEG_PER_S, SLACK_DEG = 360.0, 45.0
"""Maximum rate of rotation, and an additional rotation between two poses, in degrees."""
LEAST_POSES = 2
"""Minimum number of poses of a pair of frames that is used. A single pose may have a damaged name."""


FrameNames = tuple[str, str]
"""Reference frame and child frame of a pose."""


class LiveOdometry:
    """Latest poses by odometry. A thread of the connection adds messages, and the node asks for the pose at a scan."""

    def __init__(self, topic: str, report: Report):
        self.topic = topic
        self._report = report
        # of each pair of frames, in order
        self._poses: dict[FrameNames, deque[StampedPose]] = defaultdict(lambda: deque(maxlen=MAX_POSES))
        self._doubtful: dict[FrameNames, StampedPose] = {}
        """Last pose of each pair of frames, if it cannot follow those before it."""
        self._static: dict[FrameNames, StampedPose] = {}
        self._first_received = self._last_received = -np.inf  # until a pose arrives
        """Times of arrival of the first and the last pose, by `time.monotonic()`, in seconds."""
        self._changed = threading.Condition()
        self._chosen: tuple[FrameNames, np.ndarray] | None = None
        """Frames of the poses in use, and pose of the LiDAR in their child frame. Once chosen, they do not change."""

    def receive(self, message: Received) -> None:
        """Add the poses of a message of odometry or tf. Once frames are chosen, poses of other frames are ignored."""
        content = RosMessage(message.raw, cdr=True)
        poses = read_transforms(content) if message.kind == TRANSFORMS else [POSES[message.kind](content)]
        with self._changed:
            for pose in poses:
                frames = pose.frame, pose.child
                if self._chosen is not None and frames != self._chosen[0]:
                    continue
                if not pose.is_valid:
                    self._report(
                        "pose", f"{self.topic}: expected a position and a rotation, found {pose.numbers.tolist()}"
                    )
                    continue
                self._add(frames, pose)
                self._first_received = message.at if np.isinf(self._first_received) else self._first_received
                self._last_received = message.at
            self._changed.notify_all()

    def _add(self, frames: FrameNames, pose: StampedPose) -> None:
        """Add a pose. If it cannot follow the last one, the next one shows whether it is wrong or the odometry has
        restarted, which drops earlier poses."""
        track, doubtful = self._poses[frames], self._doubtful.pop(frames, None)
        if not track or _can_follow(track[-1], pose):
            track.append(pose)
        elif doubtful is not None and _can_follow(doubtful, pose):
            track.clear()
            track.extend((doubtful, pose))
        else:
            self._doubtful[frames] = pose
            self._report(
                "step",
                f"{self.topic}: expected a pose that can follow the last one, found another; the next one decides",
            )

    def receive_static(self, message: Received) -> None:
        """Add the transforms of a message of /tf_static."""
        with self._changed:
            transforms = read_transforms(RosMessage(message.raw, cdr=True))
            self._static |= {(pose.frame, pose.child): pose for pose in transforms if pose.is_valid}

    def pose(self, time: float, lidar: str, *, wait_s: float) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of the LiDAR at the time of a scan, or None with a report if it is unknown.

        Arguments:
          time: Time of the scan, in seconds, by the clock that stamps the poses.
          lidar: Name of the scan's frame.
          wait_s: Maximum time to wait for a pose not before the scan, in seconds. If no pose came for `SILENCE_S`
            seconds, the function does not wait.
        """

        def is_decided() -> bool:
            """Whether the poses reach the time of the scan, or no longer come."""
            self._choose_frames(lidar)
            track = self._poses[self._chosen[0]] if self._chosen else ()
            is_awaited = not track or track[-1].time < time <= track[-1].time + SILENCE_S
            return not is_awaited or clock.monotonic() - self._last_received > SILENCE_S

        with self._changed:
            self._changed.wait_for(is_decided, wait_s)
            frames, child_from_lidar = self._chosen or (None, np.eye(4))
            track = self._poses[frames] if frames else ()
            near = {pose.time: pose for pose in track if abs(pose.time - time) <= SILENCE_S}  # some tf repeats poses
            reason = self._why_missing(lidar)
        world_from_child = _interpolate(list(near.values()), time)
        if world_from_child is None:
            return self._report("odometry", f"{self.topic}: expected a pose at {time:.3f}, found {reason}")
        return world_from_child @ child_from_lidar

    def _choose_frames(self, lidar: str) -> None:
        """Choose the frames with most poses whose child frame has a known pose of the LiDAR, by its name or /tf_static.
        After `MOUNTING_WAIT_S`, poses of a single pair of frames are used as those of the LiDAR, which is reported."""
        if self._chosen is not None:
            return
        static = tracks_of_transforms((0, pose) for pose in self._static.values())
        known = {frames: len(track) for frames, track in self._poses.items() if len(track) >= LEAST_POSES}
        for frames in sorted(known, key=known.__getitem__, reverse=True):
            child = frames[1]
            child_from_lidar = np.eye(4) if child in ("", lidar) else static_transform(static, child, lidar)
            if child_from_lidar is not None:
                self._chosen = frames, child_from_lidar
                return
        if clock.monotonic() - self._first_received > MOUNTING_WAIT_S and len(known) == 1:
            (frames,) = known
            self._chosen = frames, np.eye(4)
            consequence = f"the poses are used as those of {lidar}"
            self._report("mounting", f"/tf_static: expected {frames[1]} and {lidar}, found no path; {consequence}")

    def _why_missing(self, lidar: str) -> str:
        """Return why no pose was found, for the report."""
        silent_s = clock.monotonic() - self._last_received
        if np.isinf(silent_s):
            return "no message"
        if silent_s > SILENCE_S:
            return f"none for {silent_s:.0f} s"
        if self._chosen is None:
            children = ", ".join(sorted({child for _, child in self._poses}))
            return f"poses of {children}, which tf does not connect to {lidar} rigidly"
        stamps = [pose.time for pose in self._poses[self._chosen[0]]]
        return f"poses from {min(stamps):.3f} to {max(stamps):.3f}"


def _can_follow(last: StampedPose, pose: StampedPose) -> bool:
    """Whether a vehicle can get from one pose to another, and neither clock nor odometry has restarted between them."""
    passed_s = pose.time - last.time
    moved_m = float(np.linalg.norm(pose.numbers[:3] - last.numbers[:3]))
    turned_deg = 2 * math.degrees(math.acos(min(abs(float(pose.numbers[3:] @ last.numbers[3:])), 1.0)))
    is_near = moved_m <= SLACK_M + FASTEST_M_PER_S * abs(passed_s)
    return -RESET_S <= passed_s <= PAUSE_S and is_near and turned_deg <= SLACK_DEG + FASTEST_DEG_PER_S * abs(passed_s)


def _interpolate(poses: list[StampedPose], time: float) -> Float[np.ndarray, "4 4"] | None:
    """Interpolate between the poses before and after a time. Without one of them, the two nearest poses are used.
    Returns None if no poses are near enough in time (`pose_at`)."""
    nearest = sorted(poses, key=lambda pose: abs(pose.time - time))
    before = [pose for pose in nearest if pose.time <= time][:1]
    after = [pose for pose in nearest if pose.time > time][:1]
    track = Track.of((0, pose) for pose in (before + after if before and after else nearest[:2]))
    return pose_at(track.stamps.header_s, track.poses, time)
