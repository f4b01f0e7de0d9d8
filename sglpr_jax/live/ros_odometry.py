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
from sglpr_jax.live.messages import Report
from sglpr_jax.live.ros_messages import TRANSFORMS, Received

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


class LiveOdometry:
    """Latest poses by odometry. A thread adds messages, and the node asks for the pose at the time of a scan."""

    def __init__(self, topic: str, report: Report):
        self.topic = topic
        self._report = report
        self._poses: dict[tuple[str, str], deque[StampedPose]] = defaultdict(lambda: deque(maxlen=KEPT))
        self._static: dict[tuple[str, str], StampedPose] = {}
        self._began = self._received = -np.inf
        self._changed = threading.Condition()
        self._used: tuple[tuple[str, str], np.ndarray] | None = None

    def receive(self, message: Received) -> None:
        """Add the poses of a message of odometry or tf."""
        found = RosMessage(message.raw, cdr=True)
        poses = read_transforms(found) if message.kind == TRANSFORMS else [POSES[message.kind](found)]
        with self._changed:
            for pose in map(_plain, poses):
                if self._used is not None and (pose.frame, pose.child) != self._used[0]:
                    continue
                kept = self._poses[pose.frame, pose.child]
                if kept and pose.time < kept[-1].time - BACK_S:
                    kept.clear()
                kept.append(pose)
                self._began = message.at if np.isinf(self._began) else self._began
                self._received = message.at
            self._changed.notify_all()

    def receive_static(self, message: Received) -> None:
        """Add the transforms of a message of /tf_static."""
        with self._changed:
            for pose in map(_plain, read_transforms(RosMessage(message.raw, cdr=True))):
                self._static[pose.frame, pose.child] = pose

    def pose(self, time: float, lidar: str, *, wait_s: float) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of the LiDAR at the time of a scan, or None with a report if it is unknown.

        Arguments:
          time: Time of the scan, in seconds of the clock of the poses.
          lidar: Frame of the scan.
          wait_s: Maximum time to wait for a pose after the scan, in seconds. If the odometry has stopped, the function
            does not wait.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._is_silent() or self._reaches(time, lidar), wait_s)
            found = self._used or self._use(lidar)
            key, mounting = found or (None, np.eye(4))
            near = [one for one in self._poses.get(key, ()) if abs(one.time - time) <= SILENT_S] if key else []
            why = self._why(lidar)
        pose = _at(near, time)
        if pose is None:
            self._report("odometry", f"{self.topic}: expected a pose at {time:.3f}, found {why}")
        return None if pose is None else pose @ mounting

    def _is_silent(self) -> bool:
        return clock.monotonic() - self._received > SILENT_S

    def _reaches(self, time: float, lidar: str) -> bool:
        """Whether the poses reach the time of a scan."""
        found = self._used or self._use(lidar)
        poses = () if found is None else self._poses[found[0]]
        return bool(poses) and poses[-1].time >= time

    def _use(self, lidar: str) -> tuple[tuple[str, str], np.ndarray] | None:
        """Choose the poses to use, and the mounting of the LiDAR in their child frame. Both stay as they are."""
        static = tracks_of((0, pose) for pose in self._static.values())
        for key in self._poses:
            child = key[1]
            mounting = np.eye(4) if child in ("", lidar) else fixed_transform(static, child, lidar)
            if mounting is not None:
                self._used = key, mounting
                return self._used
        waited = clock.monotonic() - self._began > STATIC_S
        if waited and len(self._poses) == 1:
            (key,) = self._poses
            found = f"found no path; the poses are used as those of {lidar}"
            self._report("mounting", f"/tf_static: expected {key[1]} and {lidar}, {found}")
            self._used = key, np.eye(4)
        return self._used

    def _why(self, lidar: str) -> str:
        """Reason for a missing pose."""
        if np.isinf(self._received):
            return "no message"
        if self._is_silent():
            return f"none for {clock.monotonic() - self._received:.0f} s"
        if self._used is None:
            children = ", ".join(sorted({child for _, child in self._poses}))
            return f"poses of {children}, which tf does not connect to {lidar} rigidly"
        stamps = [one.time for one in self._poses[self._used[0]]]
        return f"poses from {min(stamps):.3f} to {max(stamps):.3f}"


def _plain(pose: StampedPose) -> StampedPose:
    """The pose with names of frames without slashes at their ends."""
    return pose._replace(child=pose.child.strip("/"), frame=pose.frame.strip("/"))


def _at(poses: list[StampedPose], time: float) -> Float[np.ndarray, "4 4"] | None:
    """Interpolate between the poses before and after a time. The latest pose is used up to 0.1 s later."""
    nearest = sorted(poses, key=lambda one: abs(one.time - time))
    before = [one for one in nearest if one.time <= time][:1]
    after = [one for one in nearest if one.time > time][:1]
    track = Track.of((0, one) for one in (before + after if before and after else nearest[:2]))
    return pose_at(track.stamps.own, track.poses, time)
