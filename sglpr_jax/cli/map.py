"""bin/map: keep the places of a recording whose poses are known, so that later scans find themselves."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from sglpr_jax.cli.recording import RecordingOptions
from sglpr_jax.cli.runtime import parse_command, progress_bar, run
from sglpr_jax.loops.choices import SPACING_M, OdometryFormat


@dataclasses.dataclass(frozen=True)
class MapCommand:
    """Keep the places of a recording: of each a descriptor, an image and a pose, in one file.

    Examples:
      bin/map my_scans --poses poses.tum --out town.safetensors
      bin/map today --poses today.tum --add-to town.safetensors --out town.safetensors
    """

    recording: Annotated[Path, tyro.conf.Positional]
    """A dataset, a bag or a folder of scans, of any layout that is known."""
    poses: Path
    """A pose in the world for each scan: a corrected trajectory, not raw odometry."""
    out: Path
    """The map to write (.safetensors)."""
    pose_format: OdometryFormat = "auto"
    """12 numbers a line are kitti (camera axes) or lidar (z up); 8 are tum; .g2o is known by its ending."""
    add_to: Path | None = None
    """A map in the same world frame, of the same weights, whose places the new one has too."""
    spacing_m: float = SPACING_M
    """Scans nearer than this to the last place are left out."""
    weights: str = "rings"
    """The name of shipped weights, a training run's folder, or one with config.json and model.safetensors."""
    source: tyro.conf.OmitArgPrefixes[RecordingOptions] = RecordingOptions()


def write_map(command: MapCommand) -> Path:
    """Do what the command says; returns the file written."""
    from sglpr_jax.loops.odometry import read_odometry  # these bring JAX and more, which --help does not need
    from sglpr_jax.loops.places import PlaceMap
    from sglpr_jax.models.weights import weights_hash
    from sglpr_jax.models.weights_file import load

    if command.out.suffix != ".safetensors":
        raise ValueError(f"expected --out to end in .safetensors, found {command.out}")
    params = load(command.weights)
    poses = read_odometry(command.poses, format=command.pose_format)
    before = None
    if command.add_to is not None:
        before = PlaceMap.load(command.add_to, weights_hash=weights_hash(params))
    recording = command.source.open(command.recording)
    with progress_bar(f"map {recording.name}", len(recording)) as show:
        places = PlaceMap.of(recording, params, poses, spacing_m=command.spacing_m, on_progress=show)
    whole = places if before is None else before.merged(places)
    whole.save(command.out)
    print(f"{command.out}: {len(whole)} places, {len(places)} of them from {len(recording)} scans of {recording.name}")
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(MapCommand, "map"), write_map)


if __name__ == "__main__":
    main()
