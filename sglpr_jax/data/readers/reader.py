"""Interface of a dataset reader. Each file in `data/readers` defines a `Reader` with the name READER."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sglpr_jax.data.choices import PoseChoice, PoseFormat, ScanFormat, TimeUnit
from sglpr_jax.data.recording import Recording
from sglpr_jax.fields import check_value, field_types
from sglpr_jax.files import warn


@dataclass(frozen=True)
class ReadOptions:
    """Options of `open_recording` that are passed to a reader. `Reader.check_options` rejects those that do not apply,
    except `pose_source` and `time_unit`, which are ignored."""

    pose_source: PoseChoice = "auto"
    format: ScanFormat = "auto"
    poses: Path | None = None
    pose_format: PoseFormat = "auto"
    times: Path | None = None
    time_unit: TimeUnit = "auto"
    pose_topic: str | None = None
    imu_topic: str | None = None

    def __post_init__(self):
        for name in ("pose_source", "format", "pose_format", "time_unit"):
            check_value(getattr(self, name), field_types(ReadOptions)[name], name)


@dataclass(frozen=True)
class Reader:
    """Reader for one dataset layout."""

    layout: str
    """Pattern of the files for error messages: "sequences/NN/velodyne/*.bin (KITTI)". Empty for a rejected layout."""
    recording_names: Callable[[Path], tuple[str, ...]]
    """Returns the names of the recordings in a folder, in order. Empty if the folder has another layout."""
    open: Callable[[Path, str, ReadOptions], Recording]
    """Opens the recording with the given name in a folder."""
    knows_mounting: bool = True
    """Whether the layout defines the sensor mounting. Otherwise the mounting is estimated."""
    rank: int = 5
    """Priority if several layouts fit a folder: the lowest rank, then the alphabetical order of the modules."""
    takes_poses: bool = False
    """Whether `ReadOptions.poses`, `pose_format` and `times` apply. Otherwise the layout has its own pose files."""
    takes_format: bool = False
    """Whether `ReadOptions.format` applies. Otherwise the layout defines the format of the scans."""
    takes_topics: bool = False
    """Whether `ReadOptions.pose_topic` and `imu_topic` apply."""

    def check_options(self, root: Path, options: ReadOptions) -> None:
        """Raise ValueError if an option for `root` does not apply to the layout, and warn of a format that does not."""
        if not self.layout:  # `open` says why it is rejected
            return
        file = options.poses or options.times
        if file and not self.takes_poses:
            expected = "poses or times for a plain folder of scans"
            raise ValueError(f"{file}: expected {expected}, found {root}: {self.layout}")
        for kind, topic in (("pose", options.pose_topic), ("IMU", options.imu_topic)):
            if topic and not self.takes_topics:
                raise ValueError(f"{root}: expected a bag with the {kind} topic {topic}, found {self.layout}")
        if options.pose_format != "auto" and not self.takes_poses:
            raise ValueError(
                f"{root}: expected pose_format 'auto' for the layout {self.layout}, found {options.pose_format!r}"
            )
        if options.format != "auto" and not self.takes_format:  # of several datasets, it may apply to others
            warn(f"{root}: expected format 'auto' for the layout {self.layout}, found {options.format!r}, not used")
