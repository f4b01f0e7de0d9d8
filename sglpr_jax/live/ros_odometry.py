"""Poses of the LiDAR from the odometry messages of a robot, at the times of its scans."""

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
    fixed_transform,
    read_transforms,
    tracks_of,
)
from sglpr_jax.data.poses import pose_at
from sglpr_jax.live.node_messages import Report
from sglpr_jax.live.ros_encoding import TRANSFORMS, Received

KINDS = (*POSES, TRANSFORMS)
"""Types of messages with odometry."""
KEPT = 2000
"""Number of poses that are kept for each frame: two seconds at 1 kHz."""
SILENT_S = 1.0
"""Time without poses after which scans no longer wait for one, in seconds."""
STATIC_S = 3.0
"""Time from the first pose in which tf may state where the LiDAR is mounted, in seconds."""
BACK_S = 1.0
"""Step back in the times of poses with which another odometry begins, in seconds."""


Frames = tuple[str, str]
"""Reference frame and child frame of a pose."""


class LiveOdometry:
    """Latest poses by odometry. A thread adds messages, and the node asks for the pose at the time of a scan."""

    def __init__(self, topic: str, report: Report):
        self.topic = topic
        self._report = report
        self._poses: dict[Frames, deque[StampedPose]] = defaultdict(lambda: deque(maxlen=KEPT))
        self._static: dict[Frames, StampedPose] = {}
        self._began = self._received = -np.inf
        """Times of arrival of the first and the last pose, by `time.monotonic()`, in seconds."""
        self._changed = threading.Condition()
        self._used: tuple[Frames, np.ndarray] | None = None
        """Frames of the poses in use, and pose of the LiDAR in their child frame. Both stay as they are."""

    def receive(self, message: Received) -> None:
        """Add the poses of a message of odometry or tf."""
        content = RosMessage(message.raw, cdr=True)
        poses = read_transforms(content) if message.kind == TRANSFORMS else [POSES[message.kind](content)]
        with self._changed:
            for frames, pose in map(_named, poses):
                if self._used is not None and frames != self._used[0]:
                    continue
                track = self._poses[frames]
                if track and pose.time < track[-1].time - BACK_S:
                    track.clear()
                track.append(pose)
                self._began = message.at if np.isinf(self._began) else self._began
                self._received = message.at
            self._changed.notify_all()

    def receive_static(self, message: Received) -> None:
        """Add the transforms of a message of /tf_static."""
        with self._changed:
            self._static |= map(_named, read_transforms(RosMessage(message.raw, cdr=True)))

    def pose(self, time: float, lidar: str, *, wait_s: float) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of the LiDAR at the time of a scan, or None with a report if it is unknown.

        Arguments:
          time: Time of the scan, in seconds of the clock of the poses.
          lidar: Frame of the scan.
          wait_s: Maximum time to wait for a pose after the scan, in seconds. If the odometry has stopped, the function
            does not wait.
        """

        def is_decided() -> bool:
            """Whether the poses reach the time of the scan, or no longer come."""
            self._choose(lidar)
            track = self._poses[self._used[0]] if self._used else ()
            return clock.monotonic() - self._received > SILENT_S or bool(track and track[-1].time >= time)

        with self._changed:
            self._changed.wait_for(is_decided, wait_s)
            frames, child_from_lidar = self._used or (None, np.eye(4))
            track = self._poses[frames] if frames else ()
            near = [pose for pose in track if abs(pose.time - time) <= SILENT_S]
            reason = self._why_missing(lidar)
        world_from_child = _interpolate(near, time)
        if world_from_child is None:
            return self._report("odometry", f"{self.topic}: expected a pose at {time:.3f}, found {reason}")
        return world_from_child @ child_from_lidar

    def _choose(self, lidar: str) -> None:
        """Choose the poses to use, if tf states how the LiDAR is mounted in their child frame."""
        if self._used is not None:
            return
        static = tracks_of((0, pose) for pose in self._static.values())
        for frames in self._poses:
            child = frames[1]
            child_from_lidar = np.eye(4) if child in ("", lidar) else fixed_transform(static, child, lidar)
            if child_from_lidar is not None:
                self._used = frames, child_from_lidar
                return
        if clock.monotonic() - self._began > STATIC_S and len(self._poses) == 1:
            (frames,) = self._poses
            self._used = frames, np.eye(4)
            consequence = f"the poses are used as those of {lidar}"
            self._report("mounting", f"/tf_static: expected {frames[1]} and {lidar}, found no path; {consequence}")

    def _why_missing(self, lidar: str) -> str:
        """Reason for a missing pose."""
        silent_s = clock.monotonic() - self._received
        if np.isinf(silent_s):
            return "no message"
        if silent_s > SILENT_S:
            return f"none for {silent_s:.0f} s"
        if self._used is None:
            children = ", ".join(sorted({child for _, child in self._poses}))
            return f"poses of {children}, which tf does not connect to {lidar} rigidly"
        stamps = [pose.time for pose in self._poses[self._used[0]]]
        return f"poses from {min(stamps):.3f} to {max(stamps):.3f}"


def _named(pose: StampedPose) -> tuple[Frames, StampedPose]:
    """The names of the frames without slashes at their ends, and the pose with these names."""
    pose = pose._replace(child=pose.child.strip("/"), frame=pose.frame.strip("/"))
    return (pose.frame, pose.child), pose


def _interpolate(poses: list[StampedPose], time: float) -> Float[np.ndarray, "4 4"] | None:
    """Interpolate between the poses before and after a time. The latest pose is used up to 0.1 s later."""
    nearest = sorted(poses, key=lambda pose: abs(pose.time - time))
    before = [pose for pose in nearest if pose.time <= time][:1]
    after = [pose for pose in nearest if pose.time > time][:1]
    track = Track.of((0, pose) for pose in (before + after if before and after else nearest[:2]))
    return pose_at(track.stamps.own, track.poses, time)
