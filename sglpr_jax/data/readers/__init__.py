"""Readers, one file for each layout of a dataset on disk: all modules here that define READER are found by themselves.

A new layout is a new file here and its test.
"""

import functools
import importlib
import pkgutil
from pathlib import Path

from sglpr_jax.data.choices import PoseChoice, PoseFormat, ScanFormat, SensorHeight
from sglpr_jax.data.formats.scan_files import ARRAY_ENDINGS, ENDINGS
from sglpr_jax.data.listing import left_aside
from sglpr_jax.data.mounted import mounted
from sglpr_jax.data.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording


@functools.cache
def readers() -> tuple[Reader, ...]:
    """Return all readers, in the order in which they look at a folder."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    modules = [importlib.import_module(f"{__name__}.{name}") for name in names]
    found = [module.READER for module in modules if isinstance(getattr(module, "READER", None), Reader)]
    return tuple(sorted(found, key=lambda reader: reader.rank))


def recording_names(root: Path | str) -> tuple[str, ...]:
    """Return the names of the sequences in `root`, in order.

    Raises FileNotFoundError, with the layouts there are, where `root` has none of them.
    """
    return _reader_of(Path(root))[1]


def open_recording(
    root: Path | str,
    name: str | None = None,
    *,
    pose_source: PoseChoice = "auto",
    format: ScanFormat = "auto",
    sensor_height: SensorHeight = "auto",
    poses: Path | str | None = None,
    pose_format: PoseFormat = "auto",
    times: Path | str | None = None,
    pose_topic: str | None = None,
) -> Recording:
    """Open one sequence of `root`, whatever its layout.

    Without `name`, `root` must have one sequence. `pose_source` chooses between the two pose files of KITTI's layout
    and is not used for the others; `format` tells what each point of a .bin is. `sensor_height` (metres over the
    ground) says how the sensor was mounted; "auto" estimates it, and the tilt, from some scans where the layout does
    not tell. `poses` and `times` are the pose file of a plain folder and its file of seconds, where they do not lie
    beside the scans; `pose_topic` is the topic of a bag's poses, where it has several. Raises FileNotFoundError where
    something is missing, ValueError where a file is malformed, or poses are named for a layout that has its own.

    Example:
      recording = open_recording("KITTI", "08")
    """
    root = Path(root)
    reader, names = _reader_of(root)
    if name is None and len(names) == 1:
        name = names[0]
    if name is None or name not in names:
        asked = "the name of one sequence" if name is None else f"sequence {name!r}"
        raise FileNotFoundError(f"{root}: expected {asked}, found {', '.join(names)}")
    given = next((path for path in (poses, times) if path is not None), None)
    if given is not None and not reader.takes_poses:
        raise ValueError(f"{given}: expected poses named for a plain folder of scans, found {root}: {reader.layout}")
    if pose_topic is not None and not reader.takes_pose_topic:
        raise ValueError(f"{root}: expected a bag, whose topic of poses is named, {pose_topic}, found {reader.layout}")
    pose_file, times_file = (None if path is None else Path(path) for path in (poses, times))
    options = ReadOptions(pose_source, format, pose_file, pose_format, times_file, pose_topic)
    recording = reader.open(root, name, options)
    return mounted(recording, sensor_height, known=reader.knows_mounting)


def _reader_of(root: Path) -> tuple[Reader, tuple[str, ...]]:
    """The first reader that finds recordings in `root`, and their names."""
    for reader in readers():
        names = reader.recording_names(root)
        if names:
            return reader, names
    *layouts, last = (reader.layout for reader in readers() if reader.layout)
    if root.is_file():
        scan = (
            "; put scans into a folder, or read one by read_scan"
            if root.name.endswith((*ENDINGS, *ARRAY_ENDINGS))
            else ""
        )
        raise FileNotFoundError(f"{root}: expected the folder of a recording, found a single file{scan}")
    found = f"nothing of the kind: {left_aside(root, ()) or 'no files'}" if root.is_dir() else "no such folder"
    raise FileNotFoundError(f"{root}: expected {', '.join(layouts)} or {last}, found {found}")
