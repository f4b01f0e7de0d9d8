"""Opens recordings in any supported layout (`open_recording`). There is a module in this folder for each layout.

To support a new layout, add a module with a `READER` (or several as `READERS`) and a test. It is found automatically.
"""

import dataclasses
import functools
import importlib
import pkgutil
from pathlib import Path

from sglpr_jax.data.choices import Gravity, PoseChoice, PoseFormat, ScanFormat, SensorHeight, TimeUnit
from sglpr_jax.data.formats.pose_files import warn_of_heights
from sglpr_jax.data.formats.scan_files import ARRAY_ENDINGS, ENDINGS
from sglpr_jax.data.gravity import mounted
from sglpr_jax.data.readers.listing import describe_contents
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.readers.simulation import is_in_a_hand, simulated_world
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.times import check_jumps, check_order


@functools.cache
def readers() -> tuple[Reader, ...]:
    """Return the `READER` or `READERS` of all modules in this folder, by `Reader.rank`, then by file name."""
    readers = []
    for name in sorted(module.name for module in pkgutil.iter_modules(__path__)):
        module = importlib.import_module(f"{__name__}.{name}")
        readers += getattr(module, "READERS", ())
        readers += [module.READER] if hasattr(module, "READER") else []
    return tuple(sorted(readers, key=lambda reader: reader.rank))


def recording_names(root: Path | str) -> tuple[str, ...]:
    """Return the names of the sequences in `root`, in order.

    Raises FileNotFoundError, with the supported layouts, for another folder, and ValueError if a table is malformed.
    """
    return find_reader(Path(root))[1]


def open_recording(
    root: Path | str,
    name: str | None = None,
    *,
    pose_source: PoseChoice = "auto",
    format: ScanFormat = "auto",
    sensor_height: SensorHeight = "auto",
    gravity: Gravity = "auto",
    poses: Path | str | None = None,
    pose_format: PoseFormat = "auto",
    times: Path | str | None = None,
    time_unit: TimeUnit = "auto",
    pose_topic: str | None = None,
    imu_topic: str | None = None,
) -> Recording:
    """Open one sequence of `root`, in any supported layout.

    Arguments:
      root: Folder of a dataset or of scans, a bag, or a point cloud map with `poses`.
      name: Name of the sequence. It may be omitted if `root` has only one sequence.
      pose_source: Choice between the two pose files of KITTI's layout.
      format: Format of the scan files of a plain folder or of KITTI's layout. "auto" detects it.
      sensor_height: Height of the sensor above the ground, in metres. "estimate" estimates the height and the tilt from
        some scans. "auto" estimates them only if the layout does not define the mounting.
      gravity: "recording" uses one mounting for all scans, and "scan" estimates height and up of each scan, which reads
        all scans. "auto" does so if the mounting is estimated and some scans show that the sensor tilts.
      poses: Pose file of a point cloud map, or of a plain folder if it is not beside the scans.
      pose_format: Format of the pose file.
      times: File of timestamps of a plain folder, if it is not beside the scans.
      time_unit: Unit of the times in text files. "auto" expects seconds.
      pose_topic: Pose topic of a bag, by default the topic that covers the largest number of scans, "" for no poses.
      imu_topic: IMU topic of a bag, for the gravity of each scan, by default the one beside the LiDAR's topic.

    Raises:
      FileNotFoundError: If the sequence or one of its files is missing.
      ValueError: If a file is malformed, times decrease, or `poses`, `pose_format`, `times` or a topic does not
        apply to the layout.
      ImportError: If `root` is a bag and the extra `ros` is not installed.

    Example:
      recording = open_recording("KITTI", "08")
    """
    root = Path(root)
    reader, names = find_reader(root)
    if name is None and len(names) == 1:
        name = names[0]
    if name is None or name not in names:
        expected = "the name of one sequence" if name is None else f"sequence {name!r}"
        raise FileNotFoundError(f"{root}: expected {expected}, found {', '.join(names)}")
    options = ReadOptions(
        pose_source=pose_source,
        format=format,
        poses=None if poses is None else Path(poses),
        pose_format=pose_format,
        times=None if times is None else Path(times),
        time_unit=time_unit,
        pose_topic=pose_topic,
        imu_topic=imu_topic,
    )
    reader.check_options(root, options)
    recording = reader.open(root, name, options)
    recording = dataclasses.replace(recording, world=simulated_world(root, name) or recording.world)
    if recording.times is not None:
        check_order(recording.times, source=f"{root}, sequence {name}")
        check_jumps(recording.times, source=f"{root}, sequence {name}")
    if recording.positions is not None and len(recording) and not reader.takes_poses:  # others check the pose file
        warn_of_heights(recording.positions, source=f"{root}, sequence {name}")
    dataset = root / name.rpartition("/")[0]  # a recording in a folder of datasets is called DATASET/NAME
    is_known = reader.knows_mounting and not is_in_a_hand(dataset)
    return mounted(recording, sensor_height, gravity=gravity, known=is_known)


def find_reader(root: Path) -> tuple[Reader, tuple[str, ...]]:
    """Return the first reader that finds recordings in `root`, and their names, or raise FileNotFoundError."""
    for reader in readers():
        if names := reader.recording_names(root):
            return reader, names
    if root.is_file():
        is_scan = root.name.endswith((*ENDINGS, *ARRAY_ENDINGS))
        hint = "; put the scans into a folder, or read a single scan with read_scan" if is_scan else ""
        raise FileNotFoundError(f"{root}: expected the folder of a recording, found a single file{hint}")
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: expected the folder of a recording, or a bag, found no such folder")
    *layouts, last = (reader.layout for reader in readers() if reader.layout)
    contents = describe_contents(root) or "no files"
    raise FileNotFoundError(f"{root}: found no known layout: {contents}; expected {', '.join(layouts)} or {last}")
