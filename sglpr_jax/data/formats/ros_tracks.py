"""The way of something through a bag, one pose a message; and how frames that do not move lie to each other (tf)."""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.formats.ros_poses import StampedPose
from sglpr_jax.data.formats.timed_poses import poses_of

UNIT = 0.01
"""A quaternion's length may be off by so much."""


class Stamps(NamedTuple):
    """When the messages of a topic were made."""

    recorded: Int64[np.ndarray, " n"]
    """By the recorder, nanoseconds."""
    own: Float[np.ndarray, " n"]
    """By their own headers, seconds."""

    @property
    def orderly(self) -> bool:
        """Whether their own times are some, and do not go back."""
        return bool(len(self.own) and (self.own > 0).all() and (np.diff(self.own) >= 0).all())

    @property
    def seconds(self) -> Float[np.ndarray, " n"]:
        """Their own times where these are orderly, else the recorder's."""
        return self.own if self.orderly else self.recorded / 1e9


@dataclasses.dataclass(frozen=True, eq=False)
class Track:
    """The poses on a topic."""

    stamps: Stamps
    positions: Float[np.ndarray, "n 3"]
    """Metres."""
    quaternions: Float[np.ndarray, "n 4"]
    """x, y, z, w, as they are written; see `turned`."""
    child: str
    """What moves: "base_link"; empty where the messages do not say."""
    frame: str
    """In which frame: "odom"."""

    @classmethod
    def of(cls, found: Iterable[tuple[int, StampedPose]]) -> "Track":
        """The poses whose positions are finite, with the times at which they were recorded (ns)."""
        kept = [(time, pose) for time, pose in found if np.isfinite(pose.numbers[:3]).all()]
        numbers = np.array([pose.numbers for _, pose in kept], np.float64).reshape(-1, 7)
        stamps = Stamps(np.array([t for t, _ in kept], np.int64), np.array([pose.time for _, pose in kept], float))
        child, frame = (kept[0][1].child, kept[0][1].frame) if kept else ("", "")
        return cls(stamps, numbers[:, :3], numbers[:, 3:], child, frame)

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def turned(self) -> bool:
        """Whether the quaternions tell rotations: a GPS receiver leaves them at zero, or at one that never changes."""
        with np.errstate(invalid="ignore"):
            lengths = np.linalg.norm(self.quaternions, axis=1)
        return bool(len(self) and (np.abs(lengths - 1) <= UNIT).all() and np.ptp(self.quaternions, axis=0).any())

    @property
    def moves(self) -> bool:
        """Whether any pose differs from the first."""
        numbers = np.concatenate([self.positions, self.quaternions], axis=1)
        return bool(len(self) and (numbers != numbers[0]).any())

    def __str__(self) -> str:
        return f"{len(self)} poses of {self.child or 'a body'} in {self.frame or 'a frame'}"


def tracks_of(transforms: Iterable[tuple[int, StampedPose]]) -> list[Track]:
    """The transforms of tf, those of a child frame in its parent's together."""
    found: dict[tuple[str, str], list[tuple[int, StampedPose]]] = defaultdict(list)
    for time, pose in transforms:
        named = pose._replace(child=pose.child.strip("/"), frame=pose.frame.strip("/"))
        found[named.child, named.frame].append((time, named))
    return [Track.of(poses) for _, poses in sorted(found.items())]


def fixed_transform(tracks: Iterable[Track], frame: str, other: str) -> Float[np.ndarray, "4 4"] | None:
    """frame_from_other, through frames that do not move to each other; None where these do not join the two."""
    from scipy.spatial.transform import Rotation  # takes longer than all else that opens a folder of scans

    steps: dict[str, list[tuple[str, np.ndarray]]] = defaultdict(list)
    for track in tracks:
        if len(track) and not track.moves and abs(np.linalg.norm(track.quaternions[0]) - 1) <= UNIT:
            turned = Rotation.from_quat(track.quaternions[:1]).as_matrix()
            frame_from_child = poses_of(track.positions[:1], turned)[0]
            steps[track.frame].append((track.child, frame_from_child))
            steps[track.child].append((track.frame, np.linalg.inv(frame_from_child)))
    reached, queue = {frame: np.eye(4)}, [frame]
    for here in queue:
        for there, here_from_there in steps[here]:
            if there not in reached:
                reached[there] = reached[here] @ here_from_there
                queue.append(there)
    return reached.get(other)
