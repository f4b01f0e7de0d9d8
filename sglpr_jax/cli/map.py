"""bin/map: store the places of a recording with known poses, so that later scans can be located."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sglpr_jax.cli.recording import (
    AUTO,
    CloudOptions,
    RecordingOptions,
    SubmapOptions,
    beside,
    open_with_odometry,
    report_bad_scan,
)
from sglpr_jax.data.choices import ScaleChoice
from sglpr_jax.fields import NotNegative
from sglpr_jax.files import exclusive_lock, naming
from sglpr_jax.loops.config import SPACING_M
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.odometry.config import OdometryConfig, OdometryFormat
from sglpr_jax.progress import progress_bar
from sglpr_jax.stop_request import stop_on_signal

if TYPE_CHECKING:
    import numpy as np

    from sglpr_jax.maps.place_map import PlaceMap
    from sglpr_jax.models.weights import Params

UNFINISHED = ".unfinished"
"""Suffix of the folder of a running command's checkpoint, beside the map."""
ODOMETRY = ".odometry.tum"
"""Suffix of the odometry of --poses auto, beside the map."""


@dataclasses.dataclass(frozen=True)
class MapCommand:
    """Make a map of places, in which bin/relocalize finds scans. Each place is a scan with its descriptor, image and
    pose. --cloud and --grid also write a point cloud and an occupancy grid.

    Ctrl-C writes the places found until then. The same command continues a run that was interrupted or killed.

    Example:
      bin/map my_scans --poses poses.tum --out town.safetensors
      bin/map today --poses today.tum --add-to town.safetensors --out town.safetensors
      bin/map other --poses other.tum --add-to town.safetensors --frame align --out town.safetensors
      bin/map my_scans --poses auto --out town.safetensors
      bin/map my_scans --poses poses.tum --out town.safetensors --cloud town.ply --grid town.yaml
      bin/map town.pcd --poses trajectory.tum --out town.safetensors
    """

    recording: Annotated[Path, tyro.conf.Positional]
    """A dataset, a bag or a folder of scans, in any supported layout. Or a point cloud map of another tool (.pcd, .ply,
    .las, .laz), whose places are seen from the poses."""
    poses: Literal["auto"] | Path
    """File with a pose in the world frame for each scan, tum file with poses at other times, which are interpolated, or
    the bag itself. Use a corrected trajectory, as bin/loops --optimize writes it. For a point cloud map, the poses of
    its LiDAR. `auto` computes odometry from the scans (extra odometry), which suffices for a drive without revisits."""
    out: Path | None = None
    """Map to write (.safetensors). None: NAME.safetensors beside the recording NAME."""
    pose_format: OdometryFormat = "auto"
    """Format of --poses. 12 numbers a line are kitti (camera axes) or lidar (z up), and 8 numbers are tum. `auto`
    recognises tum and .g2o."""
    scan_odometry: OdometryConfig = OdometryConfig()
    """Settings of --poses auto."""
    add_to: Path | None = None
    """Existing map, made with the same weights. The new map also contains its places."""
    frame: Literal["check", "align"] = "check"
    """World frame of --poses, with --add-to. `check`: that of the existing map, and common places must agree. `align`:
    any frame; the transform to the existing map is estimated from common places."""
    spacing_m: NotNegative = SPACING_M
    """Minimum distance between places, in metres. Scans closer to the last place are skipped."""
    weights: str = DEFAULT_WEIGHTS
    """Name of shipped weights, folder of a training run, or folder with config.json and model.safetensors."""
    source: tyro.conf.OmitArgPrefixes[RecordingOptions] = RecordingOptions()
    submap: tyro.conf.OmitArgPrefixes[SubmapOptions] = SubmapOptions()
    scale: ScaleChoice = 1
    """Factor for all lengths before scans are described. 2 or 4 enlarges places that are small in an image, such as
    rooms. The map stores it, and its poses are in metres. `auto` is 4 if nine tenths of the points are less than 8 m
    away, otherwise 1."""
    output: tyro.conf.OmitArgPrefixes[CloudOptions] = CloudOptions()
    skip_bad: bool = False
    """Report unreadable scans and skip them."""

    @property
    def file(self) -> Path:
        """Map to write."""
        return self.out or beside(self.recording, self.source.seq, ".safetensors")


def write_map(command: MapCommand) -> int:
    """Run the command. Returns the exit status."""
    from sglpr_jax.models.weights_file import load

    if command.file.suffix != ".safetensors":
        raise ValueError(f"expected --out to end in .safetensors, found {command.file}")
    if command.file.is_dir():
        raise IsADirectoryError(f"{command.file}: expected a file to write, found a folder")
    command.output.check([command.recording], submap_m=command.submap.submap_m)
    params = load(command.weights)
    with exclusive_lock(command.file.with_suffix(UNFINISHED)):  # also protects --add-to if it is the same file as --out
        return _build_and_write(command, params)


def _build_and_write(command: MapCommand, params: "Params") -> int:
    """Build the map and write it, unless a stopped run would replace a larger map. Returns the exit status."""
    import numpy as np  # slow imports, not needed for --help

    from sglpr_jax.loops.checkpoint import ODOMETRY_LOG, delete_checkpoint
    from sglpr_jax.maps.build import map_recording
    from sglpr_jax.maps.place_map import PlaceMap, place_names
    from sglpr_jax.models.weights import weights_hash
    from sglpr_jax.pose_graph.files import write_tum

    existing_map = None
    if command.add_to is not None:
        existing_map = PlaceMap.load(command.add_to, weights_hash=weights_hash(params))
    pose_files = AUTO if command.poses == AUTO else (command.poses,)
    unfinished = command.file.with_suffix(UNFINISHED)
    effective, (recording,), (poses,) = open_with_odometry(
        command,
        (command.recording,),
        pose_files,
        format=command.pose_format,
        checkpoint=lambda number: unfinished / ODOMETRY_LOG,
    )
    command.output.check_recordings([recording])
    if command.poses == AUTO:
        times = recording.numbers.astype(float) if recording.times is None else recording.times
        write_tum(command.file.with_suffix(ODOMETRY), poses, times)
    if existing_map is not None:
        with naming(f"{command.add_to}"):
            existing_map.index.check(scale=effective.scale)
    with stop_on_signal() as stop, progress_bar(f"map {recording.name}", len(recording)) as show:
        new_map, scans, skipped = map_recording(
            recording,
            params,
            poses,
            spacing_m=command.spacing_m,
            scale=effective.scale,
            on_bad_scan=report_bad_scan if command.skip_bad else None,
            kept_in=unfinished,
            should_stop=stop,
            on_progress=show,
        )
    is_stopped, world_from_new = scans < len(recording), np.eye(4)
    if is_stopped and existing_map is not None and command.frame == "align":
        print("the new map is not aligned and added before it is complete")
    elif len(new_map):
        whole_map, new_places = new_map, len(new_map)
        if existing_map is not None:
            drive = dict(zip(place_names(recording), poses, strict=True))
            whole_map, world_from_new = _merge_maps(command, existing_map, new_map, drive)
            new_places = len(whole_map) - len(existing_map)
        if is_stopped and _has_more_places(command.file, len(whole_map)):
            print(f"{command.file}: unchanged, because it has more places than the {len(whole_map)} found until now")
        else:
            whole_map.save(command.file)
            scans_text = f"{scans} of {len(recording)} scans" if is_stopped else f"{scans} scans"
            skipped_text = f", {len(skipped)} scans skipped" if skipped else ""
            source = f"{new_places} of them from {scans_text} of {recording.name}{skipped_text}"
            print(f"{command.file}: {len(whole_map)} places, {source}")
    if is_stopped:
        print("run the same command again to continue", file=sys.stderr)
        return stop.exit_status
    command.output.write(
        [recording], [world_from_new @ poses], on_bad_scan=report_bad_scan if command.skip_bad else None
    )
    delete_checkpoint(unfinished)
    return 0


def _merge_maps(
    command: MapCommand, existing: "PlaceMap", new: "PlaceMap", drive: dict[str, "np.ndarray"]
) -> "tuple[PlaceMap, np.ndarray]":
    """Return the existing map with the places of the new one, and the transform from the new frame to the existing one.

    `drive` has the pose of every new scan, by its id.
    """
    import numpy as np

    from sglpr_jax.maps.alignment import align_maps, check_one_frame, without_known_places

    print("comparing up to 300 of the new places with the existing map", file=sys.stderr)
    if command.frame == "check":
        check_one_frame(existing, new)
        return existing.merged(new, drive=drive), np.eye(4)
    added = without_known_places(existing, new)
    if not len(added) and not command.output.any:
        return existing, np.eye(4)
    alignment = align_maps(existing, added if len(added) else new)
    if alignment is None:
        raise ValueError(
            f"{command.add_to}: expected places in common with {command.recording} to align the two world frames, "
            "found too few"
        )
    print(f"{command.recording}: {alignment}")
    world_from_new = alignment.old_from_new
    moved_drive = {scan_id: world_from_new @ pose for scan_id, pose in drive.items()}
    return existing.merged(added.moved(world_from_new), drive=moved_drive), world_from_new


def _has_more_places(path: Path, places: int) -> bool:
    """Return whether the file is a map with more than `places` places."""
    from sglpr_jax.maps.place_map import PlaceMap

    try:
        return len(PlaceMap.load(path)) > places
    except (OSError, ValueError):
        return False
