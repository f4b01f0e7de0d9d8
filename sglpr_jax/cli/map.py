"""bin/map: keep the places of a recording whose poses are known, so that later scans find themselves."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sglpr_jax.cli.recording import RecordingOptions, open_with_poses, report_bad_scan
from sglpr_jax.cli.runtime import parse_command, progress_bar, run, stop_on_signal
from sglpr_jax.fields import NotNegative
from sglpr_jax.loops.choices import SPACING_M, OdometryFormat
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS

if TYPE_CHECKING:
    from sglpr_jax.models.params import Params

UNFINISHED = ".unfinished"
"""The ending of the folder, beside the map, of a run that has not ended."""


@dataclasses.dataclass(frozen=True)
class MapCommand:
    """Keep the places of a recording: of each a descriptor, an image and a pose, in one file.

    Ctrl-C keeps what was found; the same command goes on after it, and after a run that was killed.

    Examples:
      bin/map my_scans --poses poses.tum --out town.safetensors
      bin/map today --poses today.tum --add-to town.safetensors --out town.safetensors
    """

    recording: Annotated[Path, tyro.conf.Positional]
    """A dataset, a bag or a folder of scans, of any layout that is known."""
    poses: Path
    """A pose in the world for each scan, or poses of other times (tum), which are interpolated: a corrected trajectory,
    not raw odometry; or the bag itself."""
    out: Path
    """The map to write (.safetensors)."""
    pose_format: OdometryFormat = "auto"
    """12 numbers a line are kitti (camera axes) or lidar (z up); 8 are tum; .g2o is known by its ending."""
    add_to: Path | None = None
    """A map in the same world frame, of the same weights, whose places the new one has too."""
    spacing_m: NotNegative = SPACING_M
    """Scans nearer than this to the last place are left out."""
    weights: str = DEFAULT_WEIGHTS
    """The name of shipped weights, a training run's folder, or one with config.json and model.safetensors."""
    source: tyro.conf.OmitArgPrefixes[RecordingOptions] = RecordingOptions()
    skip_bad: bool = False
    """Report scans that cannot be read and go on without them."""


def write_map(command: MapCommand) -> int:
    """Do what the command says; returns the exit status."""
    from sglpr_jax.loops.unfinished import alone
    from sglpr_jax.models.weights_file import load  # these bring JAX and more, which --help does not need

    if command.out.suffix != ".safetensors":
        raise ValueError(f"expected --out to end in .safetensors, found {command.out}")
    if command.out.is_dir():
        raise IsADirectoryError(f"{command.out}: expected a file to write, found a folder")
    params = load(command.weights)
    with alone(command.out.with_suffix(UNFINISHED)):  # from reading the map that is added to until it is written
        return _add_places(command, params)


def _add_places(command: MapCommand, params: "Params") -> int:
    from sglpr_jax.loops.places import PlaceMap, map_recording, poses_by_id
    from sglpr_jax.loops.unfinished import remove
    from sglpr_jax.models.weights import weights_hash

    before = None
    if command.add_to is not None:
        before = PlaceMap.load(command.add_to, weights_hash=weights_hash(params))
    recording, poses = open_with_poses(command.source, command.recording, command.poses, format=command.pose_format)
    unfinished = command.out.with_suffix(UNFINISHED)
    with stop_on_signal() as stop, progress_bar(f"map {recording.name}", len(recording)) as show:
        places, scans, skipped = map_recording(
            recording,
            params,
            poses,
            spacing_m=command.spacing_m,
            on_bad_scan=report_bad_scan if command.skip_bad else None,
            kept_in=unfinished,
            should_stop=stop,
            on_progress=show,
        )
    stopped = scans < len(recording)
    if len(places):
        whole = places if before is None else before.merged(places, drive=poses_by_id(recording, poses))
        if stopped and _holds_more(command.out, len(whole)):
            print(f"{command.out}: stays as it is, with more places than the {len(whole)} of so few scans")
        else:
            whole.save(command.out)
            new = len(whole) - (0 if before is None else len(before))
            left_out = f", {len(skipped)} scans skipped" if skipped else ""
            of = f"{scans} of {len(recording)}" if stopped else f"{scans}"
            print(f"{command.out}: {len(whole)} places, {new} of them from {of} scans of {recording.name}{left_out}")
    if stopped:
        print("the same command goes on from here", file=sys.stderr)
        return stop.exit_status
    remove(unfinished)
    return 0


def _holds_more(path: Path, places: int) -> bool:
    """Whether a map lies there already with more places: whoever uses it would be lost with fewer."""
    from sglpr_jax.loops.places import PlaceMap

    try:
        return len(PlaceMap.load(path)) > places
    except (OSError, ValueError):
        return False


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(MapCommand, "map"), lambda command: sys.exit(write_map(command)))


if __name__ == "__main__":
    main()
