"""bin/map: store the places of a recording with known poses, so that later scans can be located."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sglpr_jax.cli.recording import AUTO, RecordingOptions, SubmapOptions, open_with_odometry, report_bad_scan
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
    from sglpr_jax.models.params import Params

UNFINISHED = ".unfinished"
"""Suffix of the checkpoint directory of a running command, beside the map."""
TRAJECTORY, ODOMETRY = ".odometry.tum", ".odometry.log"
"""Suffixes of the odometry of --poses auto and of its checkpoint, beside the map."""


@dataclasses.dataclass(frozen=True)
class MapCommand:
    """Store the places of a recording in one file. Each place has a descriptor, an image and a pose.

    Ctrl-C writes the places found until then. The same command continues a run that was interrupted or killed.

    Example:
      bin/map my_scans --poses poses.tum --out town.safetensors
      bin/map today --poses today.tum --add-to town.safetensors --out town.safetensors
      bin/map other --poses other.tum --add-to town.safetensors --frame align --out town.safetensors
      bin/map my_scans --poses auto --out town.safetensors
      bin/map town.pcd --poses trajectory.tum --out town.safetensors
    """

    recording: Annotated[Path, tyro.conf.Positional]
    """A dataset, a bag or a folder of scans, in any supported layout. Or a point cloud map of another tool (.pcd, .ply,
    .las, .laz), whose places are seen from the poses."""
    poses: Literal["auto"] | Path
    """File with a pose in the world frame for each scan, tum file with poses at other times, which are interpolated, or
    the bag itself. Use a corrected trajectory, not raw odometry. For a point cloud map, the poses of its LiDAR. `auto`
    computes odometry from the scans (extra odometry) and writes it beside the map, for a drive without revisits."""
    out: Path
    """Map to write (.safetensors)."""
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
    rooms. The map stores it, and its poses are in metres. `auto` is 4 if most points are less than 8 m away, otherwise
    1."""
    skip_bad: bool = False
    """Report unreadable scans and skip them."""


def write_map(command: MapCommand) -> int:
    """Run the command. Returns the exit status."""
    from sglpr_jax.models.weights_file import load

    if command.out.suffix != ".safetensors":
        raise ValueError(f"expected --out to end in .safetensors, found {command.out}")
    if command.out.is_dir():
        raise IsADirectoryError(f"{command.out}: expected a file to write, found a folder")
    params = load(command.weights)
    with exclusive_lock(command.out.with_suffix(UNFINISHED)):  # until the new map replaces the one that is read
        return _add_places(command, params)


def _add_places(command: MapCommand, params: "Params") -> int:
    from sglpr_jax.loops.checkpoint import remove
    from sglpr_jax.maps.build import map_recording
    from sglpr_jax.maps.place_map import PlaceMap, poses_by_id
    from sglpr_jax.models.weights import weights_hash
    from sglpr_jax.pose_graph.files import write_tum
    from sglpr_jax.retrieval.descriptor_file import check_made_alike

    before = None
    if command.add_to is not None:
        before = PlaceMap.load(command.add_to, weights_hash=weights_hash(params))
    files = AUTO if command.poses == AUTO else (command.poses,)
    odometry_checkpoint = command.out.with_suffix(ODOMETRY)
    effective, (recording,), (poses,) = open_with_odometry(
        command,
        (command.recording,),
        files,
        format=command.pose_format,
        checkpoint=lambda number: odometry_checkpoint,
    )
    if command.poses == AUTO:
        times = recording.numbers.astype(float) if recording.times is None else recording.times
        write_tum(command.out.with_suffix(TRAJECTORY), poses, times)
    if before is not None:
        with naming(f"{command.add_to}"):
            check_made_alike({"scale": effective.scale}, {"scale": before.scale})
    unfinished = command.out.with_suffix(UNFINISHED)
    with stop_on_signal() as stop, progress_bar(f"map {recording.name}", len(recording)) as show:
        places, scans, skipped = map_recording(
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
    stopped = scans < len(recording)
    if stopped and before is not None and command.frame == "align":
        print("the new map is not aligned and added before it is complete")
    elif len(places):
        place_map = places if before is None else _added(command, before, places, poses_by_id(recording, poses))
        if stopped and _holds_more(command.out, len(place_map)):
            print(f"{command.out}: unchanged, because it has more places than the {len(place_map)} found until now")
        else:
            place_map.save(command.out)
            new = len(place_map) - (0 if before is None else len(before))
            left_out = f", {len(skipped)} scans skipped" if skipped else ""
            count = f"{scans} of {len(recording)}" if stopped else f"{scans}"
            new_places = f"{new} of them from {count} scans of {recording.name}{left_out}"
            print(f"{command.out}: {len(place_map)} places, {new_places}")
    if stopped:
        print("run the same command again to continue", file=sys.stderr)
        return stop.exit_status
    remove(unfinished)
    odometry_checkpoint.unlink(missing_ok=True)
    return 0


def _added(command: MapCommand, before: "PlaceMap", new: "PlaceMap", drive: dict[str, "np.ndarray"]) -> "PlaceMap":
    """The existing map with the places of the new one, in the frame that the flag states."""
    from sglpr_jax.maps.alignment import align_maps, check_one_frame, without_known_places

    print("comparing up to 300 of the new places with the existing map", file=sys.stderr)
    if command.frame == "check":
        check_one_frame(before, new)
        return before.merged(new, drive=drive)
    new = without_known_places(before, new)
    if not len(new):
        return before
    alignment = align_maps(before, new)
    if alignment is None:
        raise ValueError(
            f"{command.add_to}: expected places in common with {command.recording} to align the two world frames, "
            "found too few"
        )
    print(f"{command.recording}: {alignment}")
    world_from_new = alignment.old_from_new
    return before.merged(new.moved(world_from_new), drive={id: world_from_new @ pose for id, pose in drive.items()})


def _holds_more(path: Path, places: int) -> bool:
    """Whether the path already holds a map with more places. A smaller map must not replace it."""
    from sglpr_jax.maps.place_map import PlaceMap

    try:
        return len(PlaceMap.load(path)) > places
    except (OSError, ValueError):
        return False
