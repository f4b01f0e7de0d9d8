"""Recordings of ROS: a .bag, an .mcap, a folder of ROS 2 (metadata.yaml), or a folder of .bag or .mcap files.

A topic of point clouds is a recording. Where there is one, it has the bag's name; of several, each has its topic's,
with _ for /. Positions are those of the topic of poses that most scans have a pose on, interpolated; not the LiDAR's,
but those of the frame that the topic is about.
"""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.ros_bag import RosBag, Stamps
from sglpr_jax.data.formats.timed_poses import Interpolated, interpolate
from sglpr_jax.data.formats.trajectory import check_height
from sglpr_jax.data.listing import files_in
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording

ENDINGS = (".bag", ".mcap", ".db3")
LEAST_SHARE = 0.5
"""Of the scans must have a pose on a topic: a goal or a start that somebody set is no trajectory."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return a name for each topic of point clouds; none where there is no bag.

    Raises ValueError where a bag has no such topic or is broken, ImportError without the extra.
    """
    paths = bag_files(root)
    return tuple(_topics(root, RosBag(paths))) if paths else ()


def open_recording(root: Path, name: str) -> Recording:
    """Open the point clouds of one topic, with poses where the bag has them.

    Reads the bag once for the times, and once for each topic of poses; where poses are found, scans without one are
    left out. Raises as `recording_names` does.
    """
    bag = RosBag(bag_files(root))
    topic = _topics(root, bag)[name]
    stamps = bag.stamps(topic)
    recorded = stamps.recorded
    if not len(recorded):
        raise ValueError(f"{root}: expected point clouds on {topic}, found no message")
    ids = tuple(f"{i:06d}" for i in range(len(recorded)))
    first = np.searchsorted(recorded, recorded)  # messages of one nanosecond differ in their order
    nth = np.arange(len(recorded)) - first
    where = dict(zip(ids, zip(recorded.tolist(), nth.tolist(), strict=True), strict=True))
    recording = Recording(
        name=name,
        ids=ids,
        positions=None,
        times=stamps.seconds,
        pose_source=None,
        paths=tuple(Path(scan) for scan in ids),
        read=partial(_read, bag=bag, topic=topic, where=where),
        on_disk=False,
        found=(f"format: {topic} of {bag.name}, {bag.fields(topic, int(recorded[0]))}",),
    )
    return _with_poses(recording, bag, stamps)


def bag_files(root: Path) -> tuple[Path, ...]:
    """Return what rosbags opens together; nothing where there is no bag."""
    if root.is_file():
        return (root,) if root.suffix in ENDINGS else ()
    if (root / "metadata.yaml").is_file():
        return (root,)
    return files_in(root, ".bag") or files_in(root, ".mcap")


def _topics(root: Path, bag: RosBag) -> dict[str, str]:
    """The topics of point clouds, by the names of their recordings."""
    topics = bag.cloud_topics
    if len(topics) == 1:
        return {root.resolve().stem if root.is_file() else root.resolve().name: topics[0]}
    return {topic.strip("/").replace("/", "_"): topic for topic in topics}


def _with_poses(recording: Recording, bag: RosBag, scans: Stamps) -> Recording:
    """The recording with the positions of the topic that has most of its scans, and the others in words."""
    tracks = {topic: _positions(bag, topic, scans) for topic in bag.pose_topics}
    shares = {topic: float(found.kept.mean()) for topic, (found, _) in tracks.items()}
    best = max(shares, key=lambda topic: shares[topic], default="")
    used = best if shares.get(best, 0) >= LEAST_SHARE else ""
    others = [f"{topic} (poses for {share:.0%} of the scans)" for topic, share in shares.items() if topic != used]
    said = (*recording.found, *([f"poses not used: {', '.join(others)}"] if others else []))
    if not used:
        return dataclasses.replace(recording, found=said)
    (kept, positions), frames = tracks[used]
    check_height(positions[kept], path=bag.paths[0])
    missing = len(kept) - int(kept.sum())
    left_out = f"; {missing} of {len(kept)} scans left out, which have no pose" if missing else ""
    chosen = np.flatnonzero(kept)
    return dataclasses.replace(
        recording,
        ids=tuple(recording.ids[i] for i in chosen),
        paths=tuple(recording.paths[i] for i in chosen),
        positions=positions[kept],
        times=scans.seconds[kept],
        pose_source=f"{used} ({frames}, interpolated{left_out})",
        found=said,
    )


def _positions(bag: RosBag, topic: str, scans: Stamps) -> tuple[Interpolated, str]:
    """Where the scans were by a topic: by the messages' own times or, where those do not meet, by the recorder's."""
    track = bag.track(topic)
    own = interpolate(track.stamps.own, track.positions, scans.own)
    if scans.orderly and track.stamps.orderly and own.kept.mean() >= LEAST_SHARE:
        return own, track.frames
    return interpolate(track.stamps.recorded / 1e9, track.positions, scans.recorded / 1e9), track.frames


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
    try:
        found = bag.cloud(topic, time, nth)
    except ValueError as error:
        raise ValueError(f"scan {path.name}: {error}") from error
    return Record(points=found.points, lasers=found.lasers if lasers else None)


READER = Reader(
    layout="*.bag, *.mcap or a folder of ROS 2 (ROS)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(root, name),
    knows_mounting=False,
    rank=8,
)
