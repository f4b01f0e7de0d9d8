"""Reader of bags of ROS 1 and ROS 2: point clouds of a topic, with poses and an IMU if the bag has them."""

import dataclasses
import os
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.pose_files import warn_of_jumps
from sglpr_jax.data.formats.ros_bag import CLOUDS, COMPRESSED, METADATA, RosBag
from sglpr_jax.data.formats.ros_messages import (
    IMU,
    MOST_LATE,
    POSES,
    TRANSFORMS,
    Stamps,
    Track,
    read_imu,
    read_transforms,
    static_transform,
    times_on_one_clock,
    tracks_of_transforms,
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
"""Minimum pause between two drives in a folder of bags, in nanoseconds. The bags of one drive have no such pause."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return a name for each point cloud topic, or an empty tuple if `root` is not a bag."""
    return tuple(_recordings(root)) if bag_files(root) else ()


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the point clouds of one topic. If the bag has poses of at least half of the scans, other scans are skipped.

    Raises ValueError if the bag is broken, or if a topic has no messages, does not exist or has poses of fewer scans.
    """
    bag, topic = _recordings(root)[name]
    stamps = bag.read(topic, lambda messages: Stamps.of((time, message.header().time) for time, message in messages))
    if not len(stamps.recorder_ns):
        raise ValueError(f"{root}: expected point clouds on {topic}, found no message")
    # Several messages may have the same recorder time, so a scan is found by that time and its row among them.
    nth = np.arange(len(stamps.recorder_ns)) - np.searchsorted(stamps.recorder_ns, stamps.recorder_ns)
    if stamps.headers_are_valid(most_late=MOST_LATE):  # scans that came late are sorted by their headers
        order = np.argsort(stamps.header_s, kind="stable")
        stamps, nth = Stamps(stamps.recorder_ns[order], stamps.header_s[order]), nth[order]
    recorder_ns = stamps.recorder_ns
    times: np.ndarray | None = stamps.seconds
    if problem := time_unit_problem(times, numbers=False):
        expected = "times in seconds in the headers or of the recorder"
        warn(f"{root}, {topic}: expected {expected}, found {problem}; not used")
        times = None
    ids = tuple(f"{i:06d}" for i in range(len(recorder_ns)))
    time_and_nth = dict(zip(ids, zip(recorder_ns.tolist(), nth.tolist(), strict=True), strict=True))
    first_ns = int(recorder_ns[0])
    recording = Recording(
        name=name,
        ids=ids,
        paths=tuple(map(Path, ids)),
        read=partial(_read, bag=bag, topic=topic, time_and_nth=time_and_nth),
        times=times,
        on_disk=False,
        containers=bag.files,
        found=(f"format: {topic} of {bag.name}, {bag.describe_fields(topic, first_ns)}",),
    )
    lidar_frame = bag.message(topic, first_ns).header().frame
    recording = _with_poses(recording, bag, stamps, options.pose_topic, lidar_frame)
    imu_topic = _imu_topic(bag, topic, options.imu_topic)
    if imu_topic is None:
        return recording
    scans = Stamps(stamps.recorder_ns[recording.numbers], stamps.header_s[recording.numbers])  # without skipped scans
    read_ups = partial(_read_ups, bag, imu_topic, scans, lidar_frame, required=options.imu_topic is not None)
    return dataclasses.replace(recording, read_ups=read_ups)


def _read(
    path: Path, labels: Path | None, *, bag: RosBag, topic: str, time_and_nth: dict[str, tuple[int, int]]
) -> Scan:
    """Read a scan for a `Recording`. `path` is its id; bags have no labels, and laser numbers are always read."""
    recorder_ns, nth = time_and_nth[path.name]
    with naming(f"scan {path.name}"):
        return bag.cloud(topic, recorder_ns, nth)


def bag_files(root: Path) -> tuple[Path, ...]:
    """Return the bags at `root` (a file, a folder with metadata, or a folder of files), or () without bags."""
    endings = (*ENDINGS, *COMPRESSED)
    if root.is_file():
        return (root,) if root.name.endswith(endings) else ()
    if (root / METADATA).is_file():
        return (root,)
    return next((paths for ending in endings if (paths := files_in(root, ending))), ())


def _recordings(root: Path) -> dict[str, tuple[RosBag, str]]:
    """Return the bag and topic of each recording, by name: of the bag and topic if there are several, or of `root`."""
    all_bags = RosBag(bag_files(root))
    drives = [drive for drive in _split_into_drives(all_bags) if drive.topics_of(CLOUDS)] or [all_bags]
    recordings = {}
    for drive in drives:
        for topic in drive.cloud_topics:
            name_parts = [drive.paths[0].stem] if len(drives) > 1 else []
            name_parts += [topic.strip("/").replace("/", "_")] if len(drive.cloud_topics) > 1 else []
            name_of_root = root.resolve().stem if root.is_file() else root.resolve().name
            recordings["_".join(name_parts or [name_of_root])] = drive, topic
    return recordings


def _split_into_drives(bag: RosBag) -> list[RosBag]:
    """Split the bags where more than `PAUSE_NS` lies between them. Poses have another origin in the next drive."""
    drives: list[list[Path]] = []
    last_end = 0
    for path, start, end in sorted(bag.time_spans, key=lambda span: span[1]):
        if not drives or start - last_end > PAUSE_NS:
            drives.append([])
        drives[-1].append(path)
        last_end = max(last_end, end)
    return [bag] if len(drives) < 2 else [RosBag(paths) for paths in drives]


def _with_poses(recording: Recording, bag: RosBag, scans: Stamps, topic: str | None, lidar_frame: str) -> Recording:
    """Add the poses of `topic`, or of the topic that covers most scans (at least half), and drop the other scans."""
    if topic == "":  # no poses are wanted
        return recording
    transforms = _read_tf_tracks(bag)
    tracks = {name: _read_track(bag, name) for name in bag.topics_of(POSES)}
    for track in transforms:  # tf has poses of the LiDAR if a moving frame is connected with the LiDAR's frame
        if track.moves and static_transform(transforms, track.child, lidar_frame) is not None:
            tracks[f"/tf/{track.frame}/{track.child}"] = track
    times = {name: times_on_one_clock(track.stamps, scans) for name, track in tracks.items()}
    has_pose = {name: have_poses(pose_times, scan_times) for name, (pose_times, scan_times, _) in times.items()}
    shares = {name: float(rows.mean()) for name, rows in has_pose.items()}
    used = _pose_topic(shares, topic, bag.paths[0])
    unused = [f"{name} (poses for {share:.0%} of the scans)" for name, share in shares.items() if name != used]
    if unused:
        recording = recording.with_note(f"poses not used: {', '.join(unused)}")
    if not used:
        return recording
    track, rows = tracks[used], np.flatnonzero(has_pose[used])
    if track.dropped:
        found = f"{track.dropped} of {len(track) + track.dropped} without a position on the Earth or without rotation"
        warn(f"{bag.paths[0]}: expected valid poses on {used}, found {found}; these are dropped")
    pose_times, scan_times, problem = times[used]
    if problem:
        warn(f"{bag.paths[0]}, {used}: {problem}")
    world_from_child = interpolate_poses(pose_times, track.poses, scan_times[rows])
    warn_of_jumps(world_from_child[:, :3, 3], [recording.ids[i] for i in rows], path=bag.paths[0])
    child_from_lidar, how = _child_from_lidar(track, transforms, lidar_frame)
    world_from_lidar = world_from_child @ child_from_lidar
    return dataclasses.replace(
        recording if len(rows) == len(recording) else only(recording, rows.tolist()),
        positions=world_from_lidar[:, :3, 3],
        pose_source=f"{used} ({track}, {how}{missing_poses_note(has_pose[used])})",
        world_from_lidar=world_from_lidar if track.rotates else None,
    )


def _read_track(bag: RosBag, topic: str) -> Track:
    """Read the poses of a topic of odometry or poses, once."""
    read = POSES[bag.topics[topic]]
    return bag.read(topic, lambda messages: Track.of((time, read(message)) for time, message in messages))


def _read_tf_tracks(bag: RosBag) -> list[Track]:
    """Read the poses of each tf frame in its parent frame. Each topic of tf is read once."""
    transforms = []
    for topic in bag.topics_of(TRANSFORMS):
        messages = bag.read(topic, lambda messages: [(time, [*read_transforms(raw)]) for time, raw in messages])
        transforms += [(time, pose) for time, poses in messages for pose in poses]
    return tracks_of_transforms(transforms)


def _pose_topic(shares: dict[str, float], topic: str | None, bag: Path) -> str:
    """Return `topic`, or by default the topic with the largest share of scans with a pose, "" if none has half."""
    if topic is None:
        best = max(shares, key=lambda name: shares[name], default="")
        return best if best and shares[best] >= LEAST_SHARE else ""
    if topic not in shares:
        raise ValueError(f"{bag}: expected the pose topic {topic}, found {', '.join(shares) or 'none'}")
    if shares[topic] < LEAST_SHARE:
        raise ValueError(f"{bag}: expected poses for at least half of the scans on {topic}, found {shares[topic]:.0%}")
    return topic


def _child_from_lidar(track: Track, transforms: list[Track], lidar_frame: str) -> tuple[Float[np.ndarray, "4 4"], str]:
    """Return the transform child_from_lidar by tf, or else the identity, and how the LiDAR's poses are computed."""
    if not track.rotates:
        return np.eye(4), "interpolated; its rotations are constant or missing"
    if track.child in ("", lidar_frame):
        return np.eye(4), "interpolated"
    child_from_lidar = static_transform(transforms, track.child, lidar_frame)
    if child_from_lidar is None:
        used = f"used as poses of {lidar_frame or 'the LiDAR'}, since tf does not connect the two frames"
        return np.eye(4), f"interpolated; {used}"
    return child_from_lidar, f"interpolated, moved to {lidar_frame} by tf"


def _imu_topic(bag: RosBag, lidar_topic: str, imu_topic: str | None) -> str | None:
    """Return `imu_topic`, or by default the IMU topic nearest in name: /livox/imu for /livox/lidar."""
    topics = bag.topics_of((IMU,))
    if imu_topic is None:
        lidar = lidar_topic.strip("/")
        return max(topics, key=lambda topic: len(os.path.commonpath([topic.strip("/"), lidar])), default=None)
    if imu_topic not in topics:
        raise ValueError(f"{bag.paths[0]}: expected the IMU topic {imu_topic}, found {', '.join(topics) or 'none'}")
    return imu_topic


def _read_ups(
    bag: RosBag, topic: str, scans: Stamps, lidar_frame: str, *, required: bool
) -> tuple[Float[np.ndarray, "n 3"], str] | None:
    """Return the up direction in the LiDAR frame at each scan by an IMU, and a description of its source.

    Without gravity, raises ValueError if the IMU is `required`, or else warns and returns None.
    """
    stamps, imu_frame, imu = bag.read(topic, read_imu)
    source = f"{bag.paths[0]}, {topic}"
    imu_times, scan_times, problem = times_on_one_clock(stamps, scans)
    if problem:
        warn(f"{source}: {problem}")
    try:
        with naming(source):
            ups_in_imu, how = imu.with_times(imu_times).ups(scan_times)
    except ValueError as error:
        if required:
            raise
        warn(f"{error}; the ground of the scans is used")
        return None
    same_frame = imu_frame == lidar_frame
    lidar_from_imu = np.eye(4) if same_frame else static_transform(_read_tf_tracks(bag), lidar_frame, imu_frame)
    if lidar_from_imu is None:
        expected = f"a static transform from {imu_frame} to {lidar_frame}"
        warn(f"{source}: expected {expected}, found none; their axes are taken as parallel")
        lidar_from_imu = np.eye(4)
    return ups_in_imu @ lidar_from_imu[:3, :3].T, f"{topic}, by {how}"


READER = Reader(
    "*.bag, *.mcap or a folder of ROS 2 (ROS)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=8,
    takes_topics=True,
)
