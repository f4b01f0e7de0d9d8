"""Poses of the LiDAR at the times of scans, from the odometry messages of a robot."""

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
from sglpr_jax.live.ros_encoding import TRANSFORMS, Received

ODOMETRY_TYPES = (*POSES, TRANSFORMS)
"""Types of messages with odometry."""
MAX_POSES = 2000
"""Number of poses that are kept for each frame: two seconds at 1 kHz."""
SILENCE_S = 1.0
"""Time without poses after which scans no longer wait for one, in seconds."""
MOUNTING_WAIT_S = 3.0
"""Time from the first pose for which the mounting of the LiDAR is awaited on /tf_static, in seconds."""
RESET_S = 1.0
"""Step back in the times of poses, in seconds, beyond which the odometry has restarted: earlier poses are dropped."""


FrameNames = tuple[str, str]
"""Reference frame and child frame of a pose."""


class LiveOdometry:
    """Latest poses by odometry. A thread of the connection adds messages, and the node asks for the pose at a scan."""

    def __init__(self, topic: str, report: Report):
        self.topic = topic
        self._report = report
        # of each pair of frames, in order
        self._poses: dict[FrameNames, deque[StampedPose]] = defaultdict(lambda: deque(maxlen=MAX_POSES))
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
            for frames, pose in map(_with_frame_names, poses):
                if self._chosen is not None and frames != self._chosen[0]:
                    continue
                if not pose.is_valid:
                    self._report(
                        "pose", f"{self.topic}: expected a position and a rotation, found {pose.numbers.tolist()}"
                    )
                    continue
                track = self._poses[frames]
                if track and pose.time < track[-1].time - RESET_S:
                    track.clear()
                track.append(pose)
                self._first_received = message.at if np.isinf(self._first_received) else self._first_received
                self._last_received = message.at
            self._changed.notify_all()

    def receive_static(self, message: Received) -> None:
        """Add the transforms of a message of /tf_static."""
        with self._changed:
            transforms = read_transforms(RosMessage(message.raw, cdr=True))
            self._static |= (_with_frame_names(pose) for pose in transforms if pose.is_valid)

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
            return clock.monotonic() - self._last_received > SILENCE_S or bool(track and track[-1].time >= time)

        with self._changed:
            self._changed.wait_for(is_decided, wait_s)
            frames, child_from_lidar = self._chosen or (None, np.eye(4))
            track = self._poses[frames] if frames else ()
            near = [pose for pose in track if abs(pose.time - time) <= SILENCE_S]
            reason = self._why_missing(lidar)
        world_from_child = _interpolate(near, time)
        if world_from_child is None:
            return self._report("odometry", f"{self.topic}: expected a pose at {time:.3f}, found {reason}")
        return world_from_child @ child_from_lidar

    def _choose_frames(self, lidar: str) -> None:
        """Choose the first frames whose child frame has a known pose of the LiDAR, by its name or /tf_static. After
        `MOUNTING_WAIT_S`, poses of a single pair of frames are used as those of the LiDAR, which is reported."""
        if self._chosen is not None:
            return
        static = tracks_of_transforms((0, pose) for pose in self._static.values())
        for frames in self._poses:
            child = frames[1]
            child_from_lidar = np.eye(4) if child in ("", lidar) else static_transform(static, child, lidar)
            if child_from_lidar is not None:
                self._chosen = frames, child_from_lidar
                return
        if clock.monotonic() - self._first_received > MOUNTING_WAIT_S and len(self._poses) == 1:
            (frames,) = self._poses
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


def _with_frame_names(pose: StampedPose) -> tuple[FrameNames, StampedPose]:
    """Return the frames of a pose, without slashes at the ends of their names, and the pose with these names."""
    pose = pose._replace(child=pose.child.strip("/"), frame=pose.frame.strip("/"))
    return (pose.frame, pose.child), pose


def _interpolate(poses: list[StampedPose], time: float) -> Float[np.ndarray, "4 4"] | None:
    """Interpolate between the poses before and after a time. Without one of them, the two nearest poses are used.
    Returns None if no poses are near enough in time (`pose_at`)."""
    nearest = sorted(poses, key=lambda pose: abs(pose.time - time))
    before = [pose for pose in nearest if pose.time <= time][:1]
    after = [pose for pose in nearest if pose.time > time][:1]
    track = Track.of((0, pose) for pose in (before + after if before and after else nearest[:2]))
    return pose_at(track.stamps.header_s, track.poses, time)
