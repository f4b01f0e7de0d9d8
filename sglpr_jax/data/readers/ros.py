"""Reader of bags of ROS 1 and ROS 2: point clouds of a topic, with poses and the gravity by an IMU if there are any."""

import dataclasses
import itertools
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.formats.pose_files import check_height, check_order
from sglpr_jax.data.formats.ros_bag import CLOUDS, COMPRESSED, METADATA, RosBag
from sglpr_jax.data.formats.ros_messages import (
    IMU,
    LEAST_SHARE,
    POSES,
    Stamps,
    Track,
    fixed_transform,
    times_on_one_clock,
)
from sglpr_jax.data.imu import Imu
from sglpr_jax.data.poses import interpolate, interpolate_turns, poses_of
from sglpr_jax.data.readers.listing import files_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Record, Recording, found_record
from sglpr_jax.data.scan_stream import only
from sglpr_jax.data.times import doubt
from sglpr_jax.data.warning import warn
from sglpr_jax.files import naming


def imu_topic_of(bag: RosBag, lidar_topic: str, imu_topic: str | None) -> str | None:
    """Return `imu_topic`, or else the IMU topic whose name has most in common with the topic of the LiDAR, or None.

    Raises ValueError if `imu_topic` does not exist.
    """
    topics = bag.topics_of((IMU,))
    if imu_topic is None:
        return max(topics, key=lambda topic: _shared(topic, lidar_topic), default=None)
    if imu_topic not in topics:
        raise ValueError(f"{bag.paths[0]}: expected the IMU topic {imu_topic}, found {', '.join(topics) or 'none'}")
    return imu_topic


def _shared(topic: str, other: str) -> int:
    """Number of parts that two topics have in common: 1 for /livox/imu and /livox/lidar."""
    parts = (name.strip("/").split("/") for name in (topic, other))
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(*parts, strict=False)))


def ups_of_scans(
    bag: RosBag, topic: str, scans: Stamps, lidar: str, *, required: bool
) -> tuple[Float[np.ndarray, "n 3"], str] | None:
    """Return up in the frame of the LiDAR at each scan by an IMU, and the source in words. This reads the topic once.

    Arguments:
      bag: Bag of the scans.
      topic: Topic of the IMU.
      scans: Times of the scans.
      lidar: Frame of the LiDAR.
      required: Whether an IMU without gravity is an error. Otherwise the function warns and returns None.

    Raises:
      ValueError: If the bag is broken, or if `required` and the IMU does not measure gravity.
    """
    found = bag.imu(topic)
    source = f"{bag.paths[0]}, {topic}"
    stamps, times = times_on_one_clock(found.stamps, scans)
    order = np.argsort(stamps, kind="stable")
    turned = None if found.quaternions is None else found.quaternions[order]
    try:
        with naming(source):
            ups, how = Imu(stamps[order], found.rates[order], found.accelerations[order], turned).ups(times)
    except ValueError as error:
        if required:
            raise
        warn(f"{error}; the ground of the scans is used")
        return None
    return ups @ _lidar_from_imu(bag, found.frame.strip("/"), lidar, source).T, f"{topic}, by {how}"


def _lidar_from_imu(bag: RosBag, imu: str, lidar: str, source: str) -> Float[np.ndarray, "3 3"]:
    """Rotation from the IMU to the LiDAR by tf, or none with a warning."""
    if imu == lidar:
        return np.eye(3)
    found = fixed_transform(bag.transforms(), lidar, imu)
    if found is None:
        warn(
            f"{source}: expected a static transform from {imu} to {lidar}, found none; their axes are taken as parallel"
        )
        return np.eye(3)
    return found[:3, :3]


ENDINGS = (".bag", ".mcap", ".db3")
PAUSE_NS = 60 * 10**9
"""Minimum pause between two drives in a folder of bags, in nanoseconds. Parts of a drive follow each other at once."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return a name for each point cloud topic, or an empty tuple if `root` is not a bag.

    Raises:
      ValueError: If a bag has no point cloud topic or is broken.
      ImportError: If the extra `ros` is not installed.
    """
    return tuple(_recordings(root)) if bag_files(root) else ()


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the point clouds of one topic, with poses if the bag has them.

    The bag is read once for the times and once for each topic of poses and of tf. If a pose topic is used, scans
    without a pose are skipped. By default, this is the pose topic that covers the largest number of scans, and the IMU
    is the one whose name has most in common with that of the LiDAR.

    Raises:
      ValueError: If the bag is broken, the topic has no messages, the given pose topic covers less than half of the
        scans, or the given IMU topic does not exist.
      ImportError: If the extra `ros` is not installed.
    """
    bag, topic = _recordings(root)[name]
    stamps = bag.stamps(topic)
    recorded = stamps.recorded
    if not len(recorded):
        raise ValueError(f"{root}: expected point clouds on {topic}, found no message")
    ids = tuple(f"{i:06d}" for i in range(len(recorded)))
    first = np.searchsorted(recorded, recorded)  # `nth` numbers the messages with equal times
    nth = np.arange(len(recorded)) - first
    where = dict(zip(ids, zip(recorded.tolist(), nth.tolist(), strict=True), strict=True))
    recording = Recording(
        name=name,
        ids=ids,
        positions=None,
        times=_times(stamps, f"{root}, {topic}"),
        pose_source=None,
        paths=tuple(Path(scan) for scan in ids),
        read=partial(_read, bag=bag, topic=topic, where=where),
        on_disk=False,
        containers=bag.files,
        found=(f"format: {topic} of {bag.name}, {bag.fields(topic, int(recorded[0]))}",),
    )
    lidar = bag.frame(topic, int(recorded[0])).strip("/")
    posed = _with_poses(recording, bag, stamps, options.pose_topic, lidar)
    imu = imu_topic_of(bag, topic, options.imu_topic)
    if imu is None:
        return posed
    scans, required = stamps.of(posed.numbers), options.imu_topic is not None
    return dataclasses.replace(
        posed, read_ups=partial(ups_of_scans, bag, imu, scans=scans, lidar=lidar, required=required)
    )


def _times(stamps: Stamps, source: str) -> Float[np.ndarray, " n"] | None:
    """Times of the scans in seconds, or None with a warning if neither headers nor recorder have seconds."""
    if found := doubt(stamps.seconds, numbers=False):
        warn(f"{source}: expected times in seconds in the headers or of the recorder, found {found}; not used")
        return None
    return stamps.seconds


def bag_files(root: Path) -> tuple[Path, ...]:
    """Return the paths that rosbags opens together, or an empty tuple if `root` is not a bag."""
    endings = (*ENDINGS, *COMPRESSED)
    if root.is_file():
        return (root,) if root.name.endswith(endings) else ()
    if (root / METADATA).is_file():
        return (root,)
    return next((paths for ending in endings if (paths := files_in(root, ending))), ())


def _recordings(root: Path) -> dict[str, tuple[RosBag, str]]:
    """Bag and point cloud topic of each recording, by name."""
    whole = RosBag(bag_files(root))
    drives = [bag for bag in _drives(whole) if bag.topics_of(CLOUDS)] or [whole]
    lone = root.resolve().stem if root.is_file() else root.resolve().name
    found = {}
    for bag in drives:
        for topic in bag.cloud_topics:
            parts = [bag.paths[0].stem] if len(drives) > 1 else []
            parts += [topic.strip("/").replace("/", "_")] if len(bag.cloud_topics) > 1 else []
            found["_".join(parts) or lone] = bag, topic
    return found


def _drives(bag: RosBag) -> list[RosBag]:
    """The bags of each drive. Poses of one drive have no meaning in another one."""
    drives: list[list[Path]] = []
    last = 0
    for path, start, end in sorted(bag.parts, key=lambda part: part[1]):
        if not drives or start - last > PAUSE_NS:
            drives.append([])
        drives[-1].append(path)
        last = max(last, end)
    return [bag] if len(drives) < 2 else [RosBag(paths) for paths in drives]


class _Placed(NamedTuple):
    """A track, and its positions at the times of the scans."""

    track: Track
    clocks: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " q"]]
    """Times of the poses and of the scans, in seconds of one clock."""
    kept: Bool[np.ndarray, " q"]
    """True for scans with a pose."""
    positions: Float[np.ndarray, "q 3"]
    """Positions in metres, valid where `kept` is true."""

    @classmethod
    def at(cls, scans: Stamps, track: Track) -> "_Placed":
        """Interpolate the track at the times of the scans."""
        clocks = times_on_one_clock(track.stamps, scans)
        return cls(track, clocks, *interpolate(clocks[0], track.positions, clocks[1]))

    @property
    def share(self) -> float:
        """Fraction of scans with a pose."""
        return float(self.kept.mean())


def _with_poses(recording: Recording, bag: RosBag, scans: Stamps, topic: str | None, lidar: str) -> Recording:
    """Add the poses of `topic`, or else of the topic that covers the largest number of scans, to the recording.

    `lidar` is the frame of the scans. The unused topics are listed in `found`.
    """
    transforms = bag.transforms()
    tracks = {one: bag.track(one) for one in bag.topics_of(POSES)} | _tracks_of_lidar(transforms, lidar)
    placed = {one: _Placed.at(scans, track) for one, track in tracks.items()}
    used = _chosen(placed, topic, bag.paths[0])
    others = [f"{one} (poses for {found.share:.0%} of the scans)" for one, found in placed.items() if one != used]
    said = (*recording.found, *([f"poses not used: {', '.join(others)}"] if others else []))
    recording = dataclasses.replace(recording, found=said)
    if not used:
        return recording
    kept, positions = placed[used].kept, placed[used].positions
    check_height(positions[kept], path=bag.paths[0])
    check_order(positions[kept], [recording.ids[i] for i in np.flatnonzero(kept)], path=bag.paths[0])
    if dropped := tracks[used].dropped:
        found = f"{dropped} of {len(tracks[used]) + dropped} without finite position or without rotation"
        warn(f"{bag.paths[0]}: expected valid poses on {used}, found {found}; these are dropped")
    poses, how = _of_lidar(placed[used], transforms, lidar)
    missing = len(kept) - int(kept.sum())
    left_out = f"; {missing} of {len(kept)} scans left out, which have no pose" if missing else ""
    chosen = recording if not missing else only(recording, np.flatnonzero(kept).tolist())
    return dataclasses.replace(
        chosen,
        positions=positions[kept] if poses is None else poses[kept, :3, 3],
        pose_source=f"{used} ({tracks[used]}, {how}{left_out})",
        world_from_lidar=None if poses is None else poses[kept],
    )


def _chosen(placed: dict[str, _Placed], topic: str | None, bag: Path) -> str:
    """Return `topic`, or else the topic that covers the largest number of scans; "" if it covers less than half of
    them.

    Raises ValueError if `topic` does not exist or does not cover enough scans.
    """
    if topic is None:
        best = max(placed, key=lambda one: placed[one].share, default="")
        return best if best and placed[best].share >= LEAST_SHARE else ""
    if topic not in placed:
        raise ValueError(f"{bag}: expected the pose topic {topic}, found {', '.join(placed) or 'none'}")
    if placed[topic].share < LEAST_SHARE:
        raise ValueError(
            f"{bag}: expected poses for at least half of the scans on {topic}, found {placed[topic].share:.0%}"
        )
    return topic


def _tracks_of_lidar(transforms: list[Track], lidar: str) -> dict[str, Track]:
    """Return the tf transforms in which the LiDAR moves, with names like those of topics."""
    moving = (track for track in transforms if track.moves)
    return {
        f"/tf/{track.frame}/{track.child}": track
        for track in moving
        if fixed_transform(transforms, track.child, lidar) is not None
    }


def _of_lidar(placed: _Placed, transforms: list[Track], lidar: str) -> tuple[Float[np.ndarray, "q 4 4"] | None, str]:
    """Poses of the LiDAR, or None if the track has no rotations; and a description of how they were computed."""
    track, (poses_s, scans_s) = placed.track, placed.clocks
    if not track.turned:
        return None, "interpolated; its rotations are constant or missing"
    poses = poses_of(placed.positions, interpolate_turns(poses_s, track.quaternions, scans_s))
    child = track.child.strip("/")
    if not child or child == lidar:
        return poses, "interpolated"
    child_from_lidar = fixed_transform(transforms, child, lidar)
    if child_from_lidar is None:
        return poses, f"interpolated; used as poses of {lidar or 'the LiDAR'}, since tf does not connect the two frames"
    return poses @ child_from_lidar, f"interpolated, moved to {lidar} by tf"


def _read(
    path: Path,
    labels: Path | None,
    lasers: bool,
    *,
    bag: RosBag,
    topic: str,
    where: dict[str, tuple[int, int]],
) -> Record:
    time, nth = where[path.name]
    with naming(f"scan {path.name}"):
        found = bag.cloud(topic, time, nth)
    return found_record(found, lasers=lasers)


READER = Reader(
    "*.bag, *.mcap or a folder of ROS 2 (ROS)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=8,
    takes_topics=True,
)
