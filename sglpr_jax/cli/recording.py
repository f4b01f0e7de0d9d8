"""Flags that several commands share: recordings, their odometry, the loop detector, point clouds and grids."""

import dataclasses
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sglpr_jax.data.choices import (
    Gravity,
    PoseChoice,
    PoseFormat,
    Scale,
    ScaleChoice,
    ScanFormat,
    SensorHeight,
    TimeUnit,
)
from sglpr_jax.fields import Count, NotNegative, Share
from sglpr_jax.files import check_writable, file_name
from sglpr_jax.loops.config import MIN_PROBABILITY, CandidateConfig, DetectorConfig
from sglpr_jax.maps.config import CloudConfig, OccupancyConfig
from sglpr_jax.odometry.config import OdometryFormat
from sglpr_jax.odometry.drift_model import DRIFT_DEG_PER_100M, DRIFT_PERCENT, DriftModel
from sglpr_jax.progress import progress_bar
from sglpr_jax.registration.bev_config import VerificationConfig
from sglpr_jax.stop_request import stop_on_signal

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from jaxtyping import Float

    from sglpr_jax.data.recording import Recording
    from sglpr_jax.data.scan_stream import OnBadScan

AUTO = "auto"
"""Value of a flag for poses that are computed from the scans."""


@dataclasses.dataclass(frozen=True)
class RecordingOptions:
    """Selection of a recording in a folder, and options for reading it."""

    seq: str | None = None
    """Sequence, session of NCLT (2012-01-15), or point cloud topic of a bag that has several, with _ for /
    (livox_lidar). May be omitted if there is only one."""
    pose_source: PoseChoice = "auto"
    """Pose files of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    format: ScanFormat = "auto"
    """Point format of .bin files. `auto` detects it from the names or the content of the files."""
    sensor_height: SensorHeight = "auto"
    """Height of an upright sensor above the ground, in metres. Rarely needed: `auto` estimates height and tilt from the
    scans of plain folders and bags, and uses those that other datasets define. `estimate` always estimates them."""
    gravity: Gravity = dataclasses.field(default="auto", kw_only=True)
    """`recording`: one height and tilt for all scans. `scan`: height and tilt of each scan, for a sensor in a hand,
    from its ground and the IMU of a bag. `auto` chooses by the tilt of some scans, or `recording` if the layout or
    --sensor-height defines the mounting."""
    pose_topic: str | None = None
    """Topic of the poses of a bag, for example /odom, also if the bag is the --odometry. By default, the one that
    covers most scans is used."""
    imu_topic: str | None = dataclasses.field(default=None, kw_only=True)
    """IMU topic of a bag, for the gravity of each scan. By default, the one beside the topic of the LiDAR is used."""
    time_unit: TimeUnit = dataclasses.field(default="auto", kw_only=True)
    """Unit of the times in text files: times.txt, tum and csv. `auto` expects seconds, rejects times whose steps
    contradict this, and ignores row numbers (0, 1, 2, ...)."""

    def open(self, root: Path, **more_options: Any) -> "Recording":
        """Open the recording with the flags, which `more_options` override, and describe it on stderr."""
        from sglpr_jax.data.readers import open_recording  # slow import, not needed for --help

        flags: dict[str, Any] = {name: value for name, value in vars(self).items() if name != "seq"}
        recording = open_recording(root, self.seq, **flags | more_options)
        print("\n".join(recording.description), file=sys.stderr)
        return recording


def beside(recording: Path, seq: str | None, ending: str) -> Path:
    """Return the default output of a recording: `my_scans-loops` beside the folder my_scans, for the ending -loops."""
    path = Path(os.path.abspath(recording))  # a link stays where it is
    stem = path.name if path.is_dir() else path.stem
    return path.with_name("-".join(filter(None, (stem, seq and file_name(seq)))) + ending)


@dataclasses.dataclass(frozen=True)
class PosedRecordingOptions(RecordingOptions):
    """Selection of a recording in a folder, options for reading it, and the poses of a plain folder of scans."""

    poses: Path | None = None
    """Pose file of a plain folder, if it is not beside the scans: one row per scan, or poses at other times. Poses at
    other times are interpolated if the scans have times."""
    pose_format: PoseFormat = "auto"
    """kitti: camera frame (KITTI, SemanticKITTI); lidar: 12 numbers, z up; tum; csv with a header (x, y, z, t)."""
    times: Path | None = None
    """File of timestamps, if no times.txt is beside the scans: one number a line, in `--time-unit`."""


@dataclasses.dataclass(frozen=True)
class SubmapOptions:
    """Scans without the motion within them, and submaps in place of single scans."""

    deskew: bool = False
    """Remove the motion within each scan, before submaps are built. The points need times, and the scans need times and
    poses with rotations."""
    submap_m: NotNegative = 0.0
    """Travelled distance of a submap, in metres. 0 uses single scans. The scans of a submap are laid together in the
    frame of the newest one, which needs poses with rotations."""

    @property
    def flag(self) -> str | None:
        """Name of the stated flag that needs poses, or None."""
        if self.submap_m:
            return "--submap-m"
        return "--deskew" if self.deskew else None

    def deskewed_submaps(self, recording: "Recording", poses: "Float[np.ndarray, 'n 4 4'] | None") -> "Recording":
        """Return the recording with deskewed scans and with submaps, as far as the flags ask for them.

        Without `poses`, those of the recording's bag are used. Raises ValueError if both are missing.
        """
        if self.flag is None:
            return recording
        from sglpr_jax.data.deskew import deskewed  # slow imports, not needed for --help
        from sglpr_jax.data.submap import submaps

        poses = recording.world_from_lidar if poses is None else poses
        if poses is None:
            raise ValueError(
                f"{recording.name}: expected poses with rotations for {self.flag}, found none; state a file with "
                "--odometry"
            )
        scans = deskewed(recording, poses) if self.deskew else recording
        result = submaps(scans, poses, length_m=self.submap_m)
        new_messages = result.found[len(recording.found) :]
        print(*new_messages, sep="\n", file=sys.stderr)
        return result


@dataclasses.dataclass(frozen=True)
class CloudOptions:
    """Point cloud and occupancy grid of the scans at their poses, without moving objects. bin/loops uses the corrected
    poses."""

    cloud: Path | None = None
    """Also write the points of all scans in one frame (.ply, .pcd, .las, .laz)."""
    grid: Path | None = None
    """Also write an occupancy grid for planners, NAME.yaml and NAME.pgm, as Nav2's map server reads it."""
    cloud_settings: CloudConfig = CloudConfig()
    grid_settings: OccupancyConfig = OccupancyConfig()

    @property
    def any(self) -> bool:
        """Whether a file is asked for."""
        return self.cloud is not None or self.grid is not None

    def check(self, recordings: "Sequence[Path]", *, submap_m: float) -> None:
        """Raise an error before long work if a file cannot be written, is an input, or if scans are submaps."""
        from sglpr_jax.data.formats.cloud_writers import check_cloud_path  # slow imports, not needed for --help
        from sglpr_jax.maps.occupancy import check_grid_path

        if self.cloud is not None:
            check_cloud_path(self.cloud)
        if self.grid is not None:
            check_grid_path(self.grid)
        if self.any and submap_m:
            raise ValueError("--cloud and --grid need single scans: expected no --submap-m, found one")
        inputs = {path.resolve() for path in recordings}
        for path in filter(None, (self.cloud, self.grid)):
            check_writable(path)
            if not inputs.isdisjoint((path.resolve(), path.resolve().parent)):
                raise ValueError(f"{path}: expected a file that is no input and in no folder of scans, found one")

    def check_recordings(self, recordings: "Sequence[Recording]") -> None:
        """Raise ValueError if a file is asked for and a recording has ready-made images."""
        for recording in recordings if self.any else ():
            recording.require_scans("scans for --cloud and --grid")

    def write(
        self,
        recordings: "Sequence[Recording]",
        poses: "Sequence[Float[np.ndarray, '_ 4 4']]",
        *,
        on_bad_scan: "OnBadScan | None" = None,
    ) -> None:
        """Write the files that the flags ask for, with progress on stderr."""
        if not self.any:
            return
        from sglpr_jax.data.formats.cloud_writers import write_cloud
        from sglpr_jax.maps.occupancy import occupancy_grid
        from sglpr_jax.maps.point_cloud import point_cloud

        scans = sum(map(len, recordings)) * (1 if self.cloud_settings.keep_moving else 2)
        with progress_bar("point cloud", scans) as show:
            points = point_cloud(
                recordings, poses, config=self.cloud_settings, on_bad_scan=on_bad_scan, on_progress=show
            )
        if self.cloud is not None:
            write_cloud(self.cloud, points)
            print(f"{self.cloud}: {len(points)} points")
        if self.grid is not None:
            grid = occupancy_grid(points, driven=poses, config=self.grid_settings)
            grid.save(self.grid)
            rows, columns = grid.cells.shape
            print(f"{self.grid}: {columns} x {rows} cells of {self.grid_settings.cell_m:g} m")


@dataclasses.dataclass(frozen=True)
class OdometrySubmapOptions(SubmapOptions):
    """Deskewed scans and submaps, and the poses that these are made with."""

    odometry: Path | None = None
    """Poses for --submap-m and --deskew: file with a pose for each scan, or tum file with poses at other times, which
    are interpolated. By default, the poses of a bag are used."""
    odometry_format: OdometryFormat = "auto"
    """Format of --odometry. 12 numbers a line are kitti (camera axes) or lidar (z up), and 8 numbers are tum. `auto`
    recognises tum and .g2o."""

    def open(self, source: RecordingOptions, root: Path) -> "Recording":
        """Open a recording, deskewed and with submaps if these are selected. Scans without a pose are then removed."""
        if self.odometry is None:
            return self.deskewed_submaps(source.open(root), None)
        if self.flag is None:
            raise ValueError(f"{self.odometry}: expected --submap-m or --deskew with --odometry, found neither")
        recording, poses = open_with_poses(source, root, self.odometry, format=self.odometry_format)
        return self.deskewed_submaps(recording, poses)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectorFlags:
    """Settings of the loop detector, with the drift of the odometry in usual units."""

    drift_percent: NotNegative = DRIFT_PERCENT
    """Position drift of the odometry: one standard deviation, in percent of the travelled distance. Loops that need
    more than four standard deviations are rejected as contradicting the odometry: raise it then."""
    drift_deg_per_100m: NotNegative = DRIFT_DEG_PER_100M
    """Heading drift of the odometry: one standard deviation, in degrees per 100 m."""
    min_probability: Share = MIN_PROBABILITY
    """Minimum probability of a loop."""
    keyframe_m: NotNegative = DetectorConfig.keyframe_m
    """Distance between the keyframes, in metres, and a fifth of it where places look alike. Only these scans are
    searched and stored. 0 searches every scan."""
    max_places: Count | None = DetectorConfig.max_places
    """Maximum number of stored scans, to limit memory. By default all are stored."""
    candidates: CandidateConfig = DetectorConfig.candidates
    verification: VerificationConfig = DetectorConfig.verification

    @property
    def detector(self) -> DetectorConfig:
        """Settings of the detector. Raises ValueError if one of them is invalid."""
        drift = DriftModel(metres_per_metre=self.drift_percent / 100, degrees_per_metre=self.drift_deg_per_100m / 100)
        names = [field.name for field in dataclasses.fields(DetectorConfig) if field.name != "drift"]
        return DetectorConfig(drift=drift, **{name: getattr(self, name) for name in names})


def open_with_poses(
    source: RecordingOptions, root: Path, path: Path, *, format: OdometryFormat
) -> "tuple[Recording, Float[np.ndarray, 'n 4 4']]":
    """Open a recording, with a pose for each scan from the file at `path`, or from the bag if `path` is the bag itself.

    Poses at other times are interpolated. Scans without a pose are removed and reported on stderr. If `root` is a point
    cloud map, the scans are those that its LiDAR would measure at the poses.
    """
    from sglpr_jax.data.formats.scan_files import is_cloud_file
    from sglpr_jax.pose_graph.odometry_files import is_bag_of_recording, match_to_scans, read_stamped, take_bag_odometry

    if is_cloud_file(root):
        return take_bag_odometry(source.open(root, poses=path, pose_format=format), root)
    if is_bag_of_recording(path, root):
        return take_bag_odometry(source.open(root), root)
    odometry = read_stamped(path, format=format, time_unit=source.time_unit)  # read first, because a bag opens slowly
    whole_recording = source.open(root)
    recording, poses = match_to_scans(whole_recording, *odometry, path)
    print(f"trajectory: {path}", file=sys.stderr)  # the description above may name other poses, of the dataset
    if recording is not whole_recording:  # its last message says how many scans were removed
        print(recording.found[-1], file=sys.stderr)
    return recording, poses


def resolved_scale(choice: ScaleChoice, *recordings: "Recording") -> Scale:
    """Return the stated scale. With `auto`, return and print the smallest of the scales that fit the recordings."""
    from sglpr_jax.data.scaled import chosen_scale  # slow import, not needed for --help

    if choice != "auto":
        return choice
    scale: Scale = min(chosen_scale(recording) for recording in recordings)
    print(f"scale: {scale}, chosen by the ranges of the scans", file=sys.stderr)
    return scale


def report_bad_scan(scan: str, error: Exception) -> None:
    """Report on stderr that a scan is skipped, with the reason."""
    print(f"skipped {scan}: {error}", file=sys.stderr)


def open_with_odometry(
    command: Any,
    paths: "Sequence[Path]",
    odometry: "Literal['auto'] | Sequence[Path]",
    *,
    format: OdometryFormat,
    checkpoint: "Callable[[int], Path]",
) -> "tuple[Any, list[Recording], list[Float[np.ndarray, 'n 4 4']]]":
    """Open the recordings of a `LoopsCommand` or `MapCommand` with their odometry, deskewed and with submaps.

    Arguments:
      command: Command with its flags.
      paths: Recordings.
      odometry: `auto`, a file for each recording, or an empty sequence.
      format: Format of the files.
      checkpoint: Returns the checkpoint file of the odometry of a recording, given its number.

    Returns:
      The command with the values that replace `auto`, the recordings, and a list of their odometry or an empty list.
    """
    from sglpr_jax.data.deskew import point_times_problem  # slow imports, not needed for --help
    from sglpr_jax.odometry.kiss_icp import check_installed

    poses, submaps = [], [command.submap] * len(paths)
    if odometry == AUTO:
        check_installed()
        recordings = [command.source.open(path) for path in paths]
        command = dataclasses.replace(command, scale=resolved_scale(command.scale, *recordings))
        poses = [_odometry_of(recording, command, checkpoint(number)) for number, recording in enumerate(recordings)]
        has_times = [not point_times_problem(recording) for recording in recordings]
        submaps = [dataclasses.replace(command.submap, deskew=command.submap.deskew or has) for has in has_times]
        submap = dataclasses.replace(command.submap, deskew=all(each.deskew for each in submaps))
        settings = dataclasses.replace(command.scan_odometry, voxel_m=command.scan_odometry.used_voxel_m)
        command = dataclasses.replace(command, submap=submap, scan_odometry=settings)
    elif odometry:
        files = zip(paths, odometry, strict=True)
        pairs = [open_with_poses(command.source, path, file, format=format) for path, file in files]
        recordings, poses = map(list, zip(*pairs, strict=True))
    else:
        recordings = [command.source.open(path) for path in paths]
    poses_or_none = poses or [None] * len(recordings)
    recordings = [
        submap.deskewed_submaps(recording, recording_poses)
        for submap, recording, recording_poses in zip(submaps, recordings, poses_or_none, strict=True)
    ]
    return dataclasses.replace(command, scale=resolved_scale(command.scale, *recordings)), recordings, poses


def _odometry_of(recording: "Recording", command: Any, checkpoint: Path) -> "Float[np.ndarray, 'n 4 4']":
    """Compute the odometry of a recording, with progress on stderr. Exits if a signal stops it before the end."""
    from sglpr_jax.odometry.kiss_icp import describe_odometry, scan_odometry

    if not recording.has_images:
        print(describe_odometry(recording, command.scan_odometry, scale=command.scale), file=sys.stderr)
    with stop_on_signal() as stop, progress_bar(f"odometry {recording.name}", len(recording)) as show:
        poses = scan_odometry(
            recording,
            config=command.scan_odometry,
            scale=command.scale,
            kept_in=checkpoint,
            on_bad_scan=report_bad_scan if command.skip_bad else None,
            should_stop=stop,
            on_progress=show,
        )
    if len(poses) < len(recording):
        print(f"odometry of {len(poses)} of {len(recording)} scans; run the same command again to continue")
        sys.exit(stop.exit_status)
    return poses
