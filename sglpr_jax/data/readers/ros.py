"""Recordings of ROS: a .bag, an .mcap, a folder of ROS 2 (metadata.yaml), or a folder of .bag or .mcap files.

A topic of point clouds is a recording. Where there is one, it has the bag's name; of several, each has its topic's,
with _ for /. Poses are not read from bags.
"""

from functools import partial
from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.ros_bag import RosBag
from sglpr_jax.data.listing import files_in
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording

ENDINGS = (".bag", ".mcap", ".db3")


def recording_names(root: Path) -> tuple[str, ...]:
    """Return a name for each topic of point clouds; none where there is no bag.

    Raises ValueError where a bag has no such topic or is broken, ImportError without the extra.
    """
    paths = bag_files(root)
    return tuple(_topics(root, RosBag(paths))) if paths else ()


def open_recording(root: Path, name: str) -> Recording:
    """Open the point clouds of one topic. Reads the bag once, for their times. Raises as `recording_names` does."""
    bag = RosBag(bag_files(root))
    topic = _topics(root, bag)[name]
    recorded, times = bag.stamps(topic)
    if not len(recorded):
        raise ValueError(f"{root}: expected point clouds on {topic}, found no message")
    ids = tuple(f"{i:06d}" for i in range(len(recorded)))
    first = np.searchsorted(recorded, recorded)  # messages of one nanosecond differ in their order
    nth = np.arange(len(recorded)) - first
    where = dict(zip(ids, zip(recorded.tolist(), nth.tolist(), strict=True), strict=True))
    return Recording(
        name=name,
        ids=ids,
        positions=None,
        times=times,
        pose_source=None,
        paths=tuple(Path(scan) for scan in ids),
        read=partial(_read, bag=bag, topic=topic, where=where),
        on_disk=False,
        found=(f"format: {topic} of {bag.name}, {bag.fields(topic, int(recorded[0]))}",),
    )


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
