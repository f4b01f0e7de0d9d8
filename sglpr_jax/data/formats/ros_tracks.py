"""Tracks of frames through a bag, with one pose per message, and transforms between static frames (tf)."""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int64
from numpy.typing import ArrayLike

from sglpr_jax.data.formats.ros_poses import StampedPose
from sglpr_jax.data.formats.timed_poses import interpolate, poses_of
from sglpr_jax.data.times import doubt

LEAST_SHARE = 0.5
"""Minimum fraction of scans with a pose on a topic. Topics with fewer, such as a navigation goal, are not used."""
UNIT = 0.01
"""Maximum deviation of the length of a quaternion from 1."""


class Stamps(NamedTuple):
    """Timestamps of the messages of a topic."""

    recorded: Int64[np.ndarray, " n"]
    """Times of the recorder, in nanoseconds."""
    own: Float[np.ndarray, " n"]
    """Times in the headers of the messages, in seconds."""

    def of(self, rows: Int[np.ndarray, " m"]) -> "Stamps":
        """Stamps of some messages."""
        return Stamps(self.recorded[rows], self.own[rows])

    @property
    def orderly(self) -> bool:
        """Whether the header times are positive, never decrease, and can be seconds (`times.doubt`)."""
        ordered = len(self.own) and (self.own > 0).all() and (np.diff(self.own) >= 0).all()
        return bool(ordered and not doubt(self.own, numbers=False))

    @property
    def seconds(self) -> Float[np.ndarray, " n"]:
        """Header times in seconds if they are orderly, or else the recorder's times."""
        return self.own if self.orderly else self.recorded / 1e9


@dataclasses.dataclass(frozen=True, eq=False)
class Track:
    """Poses of a topic."""

    stamps: Stamps
    positions: Float[np.ndarray, "n 3"]
    """Positions in metres."""
    quaternions: Float[np.ndarray, "n 4"]
    """Quaternions x, y, z, w. The quaternions are not normalised and may be invalid (see `turned`)."""
    child: str
    """Child frame, such as "base_link". Empty if the messages do not name it."""
    frame: str
    """Reference frame, such as "odom"."""
    dropped: int = 0
    """Number of messages without a valid pose, which are not part of the track."""

    @classmethod
    def of(cls, found: Iterable[tuple[int, StampedPose]]) -> "Track":
        """Create a track from recorder times (ns) and poses. Poses with non-finite positions are dropped.

        If most poses have a rotation, those without one are dropped, too.
        """
        given = list(found)
        placed = [(time, pose) for time, pose in given if np.isfinite(pose.numbers[:3]).all()]
        valid = are_unit([pose.numbers[3:] for _, pose in placed])
        turned = [one for one, fits in zip(placed, valid, strict=True) if fits]
        kept = turned if 2 * len(turned) > len(placed) else placed
        numbers = np.array([pose.numbers for _, pose in kept], np.float64).reshape(-1, 7)
        stamps = Stamps(np.array([t for t, _ in kept], np.int64), np.array([pose.time for _, pose in kept], float))
        child, frame = (kept[0][1].child, kept[0][1].frame) if kept else ("", "")
        return cls(stamps, numbers[:, :3], numbers[:, 3:], child, frame, len(given) - len(kept))

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def turned(self) -> bool:
        """Whether the quaternions are valid rotations that change. A GPS receiver writes zeros or a constant."""
        return bool(len(self) and are_unit(self.quaternions).all() and np.ptp(self.quaternions, axis=0).any())

    @property
    def moves(self) -> bool:
        """Whether any pose differs from the first."""
        numbers = np.concatenate([self.positions, self.quaternions], axis=1)
        return bool(len(self) and (numbers != numbers[0]).any())

    def __str__(self) -> str:
        return f"{len(self)} poses of {self.child or 'a body'} in {self.frame or 'a frame'}"


def are_unit(quaternions: ArrayLike) -> Bool[np.ndarray, " n"]:
    """Whether each quaternion has length 1."""
    with np.errstate(invalid="ignore", over="ignore"):
        lengths = np.linalg.norm(np.reshape(np.asarray(quaternions, np.float64), (-1, 4)), axis=1)
        return np.abs(lengths - 1) <= UNIT


def tracks_of(transforms: Iterable[tuple[int, StampedPose]]) -> list[Track]:
    """Group tf transforms into one track for each pair of child and parent frame."""
    found: dict[tuple[str, str], list[tuple[int, StampedPose]]] = defaultdict(list)
    for time, pose in transforms:
        named = pose._replace(child=pose.child.strip("/"), frame=pose.frame.strip("/"))
        found[named.child, named.frame].append((time, named))
    return [Track.of(poses) for _, poses in sorted(found.items())]


def times_on_one_clock(stamps: Stamps, scans: Stamps) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " q"]]:
    """Times of messages and of scans in seconds: header times, or recorder times if the headers do not overlap."""
    if scans.orderly and stamps.orderly:
        own = interpolate(stamps.own, np.zeros((len(stamps.own), 3)), scans.own)
        if own.kept.mean() >= LEAST_SHARE:
            return stamps.own, scans.own
    return stamps.recorded / 1e9, scans.recorded / 1e9


def fixed_transform(tracks: Iterable[Track], frame: str, other: str) -> Float[np.ndarray, "4 4"] | None:
    """Return the transform frame_from_other along static tracks, or None if no static tracks connect the two frames."""
    from scipy.spatial.transform import Rotation  # imported here because the import is slow

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
