"""What a reader of a dataset's layout is: each file of `data/readers` defines one, under the name READER."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sglpr_jax.data.choices import PoseChoice, PoseFormat, ScanFormat
from sglpr_jax.data.recording import Recording
from sglpr_jax.fields import check_value, field_types


@dataclass(frozen=True)
class ReadOptions:
    """What a user may say about a dataset; a reader uses what concerns it. Raises ValueError for an unknown choice."""

    pose_source: PoseChoice = "auto"
    format: ScanFormat = "auto"
    """What each point of a .bin is, in a plain folder or KITTI's layout."""
    poses: Path | None = None
    """The pose file of a plain folder, where it does not lie beside the scans."""
    pose_format: PoseFormat = "auto"
    times: Path | None = None
    """Seconds, one number a line."""
    pose_topic: str | None = None
    """The topic of a bag's poses, where it has several."""

    def __post_init__(self):
        for name in ("pose_source", "format", "pose_format"):
            check_value(getattr(self, name), field_types(ReadOptions)[name], name)


@dataclass(frozen=True)
class Reader:
    """One layout of a dataset on disk."""

    layout: str
    """How to recognise it, for a message: "sequences/NN/velodyne/*.bin (KITTI)"; empty where it is always refused."""
    recording_names: Callable[[Path], tuple[str, ...]]
    """The names of the recordings in a folder, in order; none where the folder has another layout."""
    open: Callable[[Path, str, ReadOptions], Recording]
    """Open one of them."""
    knows_mounting: bool = True
    """Whether scans of this layout come from sensors as models know them; else the mounting is estimated."""
    rank: int = 5
    """Where two layouts fit one folder, that of the lower rank is taken; then the first by name of its file."""
    takes_poses: bool = False
    """Whether `ReadOptions.poses` and `times` concern it; else the layout has pose files of its own."""
    takes_pose_topic: bool = False
    """Whether `ReadOptions.pose_topic` concerns it."""
