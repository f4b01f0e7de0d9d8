"""Reader of bags of ROS 1 and ROS 2: point clouds of a topic, with poses and the gravity by an IMU if there are any."""

import dataclasses
import os
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.pose_files import check_height, check_order
from sglpr_jax.data.formats.ros_bag import CLOUDS, COMPRESSED, METADATA, RosBag
from sglpr_jax.data.formats.ros_messages import (
    IMU,
    POSES,
    TRANSFORMS,
    Stamps,
    Track,
    fixed_transform,
    read_imu,
    read_transforms,
    times_on_one_clock,
    tracks_of,
)
from sglpr_jax.data.poses import LEAST_SHARE, have_poses, interpolate_poses, missing_poses_note
from sglpr_jax.data.readers.listing import files_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import only
from sglpr_jax.data.times import time_unit_problem
from sglpr_jax.files import naming, warn

ENDINGS = (".bag", ".mcap", ".db3")
PAUSE_NS = 60 * 10**9
"""Minimum pause between two drives in a folder of bags, in nanoseconds. Parts of a drive follow each other at once."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return a name for each point cloud topic, or an empty tuple if `root` is not a bag."""
    return tuple(_recordings(root)) if bag_files(root) else ()


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the point clouds of one topic, with poses if the bag has them. Scans without a pose are skipped then.

    The bag is read once for the times and once for each topic of poses and of tf. Raises ValueError if the bag is
    broken, the topic has no messages, or a given topic does not exist or does not cover half of the scans.
    """
    bag, topic = _recordings(root)[name]
    stamps = bag.read(topic, lambda messages: Stamps.of((time, message.header().time) for time, message in messages))
    recorded = stamps.recorded
    if not len(recorded):
        raise ValueError(f"{root}: expected point clouds on {topic}, found no message")
    times: np.ndarray | None = stamps.seconds
    if problem := time_unit_problem(times, numbers=False):
        expected = "times in seconds in the headers or of the recorder"
        warn(f"{root}, {topic}: expected {expected}, found {problem}; not used")
        times = None
    ids = tuple(f"{i:06d}" for i in range(len(recorded)))
    nth = np.arange(len(recorded)) - np.searchsorted(recorded, recorded)  # number among messages with equal times
    where = dict(zip(ids, zip(recorded.tolist(), nth.tolist(), strict=True), strict=True))
    recording = Recording(
        name=name,
        ids=ids,
        paths=tuple(map(Path, ids)),
        read=partial(_read, bag=bag, topic=topic, where=where),
        times=times,
        on_disk=False,
        containers=bag.files,
        found=(f"format: {topic} of {bag.name}, {bag.fields(topic, int(recorded[0]))}",),
    )
    lidar = bag.message(topic, int(recorded[0])).header().frame.strip("/")
    recording = _with_poses(recording, bag, stamps, options.pose_topic, lidar)
    imu = _imu_topic(bag, topic, options.imu_topic)
    if imu is None:
        return recording
    scans = Stamps(*(times[recording.numbers] for times in stamps))
    required = options.imu_topic is not None
    return dataclasses.replace(recording, read_ups=partial(_ups, bag, imu, scans=scans, lidar=lidar, required=required))


def _read(
    path: Path, labels: Path | None, lasers: bool, *, bag: RosBag, topic: str, where: dict[str, tuple[int, int]]
) -> Scan:
    with naming(f"scan {path.name}"):
        return bag.cloud(topic, *where[path.name])


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
    recordings = {}
    for bag in drives:
        for topic in bag.cloud_topics:
            parts = [bag.paths[0].stem] if len(drives) > 1 else []
            parts += [topic.strip("/").replace("/", "_")] if len(bag.cloud_topics) > 1 else []
            parts = parts or [root.resolve().stem if root.is_file() else root.resolve().name]
            recordings["_".join(parts)] = bag, topic
    return recordings


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


def _with_poses(recording: Recording, bag: RosBag, scans: Stamps, topic: str | None, lidar: str) -> Recording:
    """Add the poses of `topic`, or of the topic that covers most scans. `lidar` is the frame of the scans."""
    transforms = _transforms(bag)
    tracks = {name: _track(bag, name) for name in bag.topics_of(POSES)} | {
        f"/tf/{track.frame}/{track.child}": track
        for track in transforms
        if track.moves and fixed_transform(transforms, track.child, lidar) is not None
    }
    clocks = {name: times_on_one_clock(track.stamps, scans) for name, track in tracks.items()}
    covered = {name: have_poses(*clock) for name, clock in clocks.items()}
    shares = {name: float(rows.mean()) for name, rows in covered.items()}
    used = _pose_topic(shares, topic, bag.paths[0])
    others = [f"{name} (poses for {share:.0%} of the scans)" for name, share in shares.items() if name != used]
    if others:
        found = (*recording.found, f"poses not used: {', '.join(others)}")
        recording = dataclasses.replace(recording, found=found)
    if not used:
        return recording
    track, rows, (stamps, times) = tracks[used], np.flatnonzero(covered[used]), clocks[used]
    if track.dropped:
        found = f"{track.dropped} of {len(track) + track.dropped} without finite position or without rotation"
        warn(f"{bag.paths[0]}: expected valid poses on {used}, found {found}; these are dropped")
    poses = interpolate_poses(stamps, track.poses, times[rows])
    check_height(poses[:, :3, 3], path=bag.paths[0])
    check_order(poses[:, :3, 3], [recording.ids[i] for i in rows], path=bag.paths[0])
    child_from_lidar, how = _child_from_lidar(track, transforms, lidar)
    poses = poses @ child_from_lidar
    return dataclasses.replace(
        recording if len(rows) == len(recording) else only(recording, rows.tolist()),
        positions=poses[:, :3, 3],
        pose_source=f"{used} ({track}, {how}{missing_poses_note(covered[used])})",
        world_from_lidar=poses if track.turned else None,
    )


def _track(bag: RosBag, topic: str) -> Track:
    """Poses of a topic. This reads the topic once."""
    read = POSES[bag.topics[topic]]
    return bag.read(topic, lambda messages: Track.of((time, read(message)) for time, message in messages))


def _transforms(bag: RosBag) -> list[Track]:
    """Poses of each frame of tf in its parent frame. This reads each topic of tf once."""
    transforms = []
    for topic in bag.topics_of(TRANSFORMS):
        messages = bag.read(topic, lambda messages: [(time, [*read_transforms(raw)]) for time, raw in messages])
        transforms += [(time, pose) for time, poses in messages for pose in poses]
    return tracks_of(transforms)


def _pose_topic(shares: dict[str, float], topic: str | None, bag: Path) -> str:
    """Return `topic`, or else the topic that covers most scans; "" if it covers less than half of them."""
    if topic is None:
        best = max(shares, key=lambda name: shares[name], default="")
        return best if best and shares[best] >= LEAST_SHARE else ""
    if topic not in shares:
        raise ValueError(f"{bag}: expected the pose topic {topic}, found {', '.join(shares) or 'none'}")
    if shares[topic] < LEAST_SHARE:
        raise ValueError(f"{bag}: expected poses for at least half of the scans on {topic}, found {shares[topic]:.0%}")
    return topic


def _child_from_lidar(track: Track, transforms: list[Track], lidar: str) -> tuple[Float[np.ndarray, "4 4"], str]:
    """Transform from the LiDAR to the body of a track, and a description of how the poses were computed."""
    if not track.turned:
        return np.eye(4), "interpolated; its rotations are constant or missing"
    child = track.child.strip("/")
    if not child or child == lidar:
        return np.eye(4), "interpolated"
    child_from_lidar = fixed_transform(transforms, child, lidar)
    if child_from_lidar is None:
        used = f"used as poses of {lidar or 'the LiDAR'}, since tf does not connect the two frames"
        return np.eye(4), f"interpolated; {used}"
    return child_from_lidar, f"interpolated, moved to {lidar} by tf"


def _imu_topic(bag: RosBag, lidar_topic: str, imu_topic: str | None) -> str | None:
    """Return `imu_topic`, or else the IMU topic whose name begins most like that of the LiDAR: /livox/imu."""
    topics = bag.topics_of((IMU,))
    if imu_topic is None:
        lidar = lidar_topic.strip("/")
        return max(topics, key=lambda topic: len(os.path.commonpath([topic.strip("/"), lidar])), default=None)
    if imu_topic not in topics:
        raise ValueError(f"{bag.paths[0]}: expected the IMU topic {imu_topic}, found {', '.join(topics) or 'none'}")
    return imu_topic


def _ups(
    bag: RosBag, topic: str, scans: Stamps, lidar: str, *, required: bool
) -> tuple[Float[np.ndarray, "n 3"], str] | None:
    """Return up in the frame of the LiDAR at each scan by an IMU, and the source in words. This reads the topic once.

    Without gravity, raises ValueError if the IMU is `required`, or else warns and returns None.
    """
    recorded, frame, imu = bag.read(topic, read_imu)
    source = f"{bag.paths[0]}, {topic}"
    stamps, times = times_on_one_clock(recorded, scans)
    try:
        with naming(source):
            ups, how = imu.with_times(stamps).ups(times)
    except ValueError as error:
        if required:
            raise
        warn(f"{error}; the ground of the scans is used")
        return None
    frame = frame.strip("/")
    lidar_from_imu = np.eye(4) if frame == lidar else fixed_transform(_transforms(bag), lidar, frame)
    if lidar_from_imu is None:
        expected = f"a static transform from {frame} to {lidar}"
        warn(f"{source}: expected {expected}, found none; their axes are taken as parallel")
        lidar_from_imu = np.eye(4)
    return ups @ lidar_from_imu[:3, :3].T, f"{topic}, by {how}"


READER = Reader(
    "*.bag, *.mcap or a folder of ROS 2 (ROS)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=8,
    takes_topics=True,
)
