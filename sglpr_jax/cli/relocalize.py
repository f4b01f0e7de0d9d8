"""bin/relocalize: where in a map was a scan taken?"""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table

from sglpr_jax.cli.runtime import console, parse_command, run
from sglpr_jax.data.choices import ScanFormat, SensorHeight
from sglpr_jax.data.mounting import Mounting, estimate_mounting
from sglpr_jax.data.readers.bev_images import read_image
from sglpr_jax.data.record import Record, scan_record
from sglpr_jax.files import write_json
from sglpr_jax.loops.places import CANDIDATES, PlaceMap, Relocated
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.models.weights_file import load


@dataclasses.dataclass(frozen=True)
class RelocalizeCommand:
    """Find the pose of a scan in a map that bin/map wrote, with its probability, by each of the places most like it.

    Examples:
      bin/relocalize my_scans/000003.bin --map town.safetensors
      bin/relocalize my_scans/000003.bin --map town.safetensors --out pose.json
    """

    scan: Annotated[Path, tyro.conf.Positional]
    """A scan (.bin, .pcd) or a ready-made image (.png)."""
    map: Path
    """The map."""
    out: Path | None = None
    """A JSON file for the answers: place, probability, world_from_query (4 x 4), covariance."""
    candidates: int = CANDIDATES
    """How many places are looked at."""
    weights: str = "rings"
    """The weights that made the map."""
    format: ScanFormat = "auto"
    """What the scan is, where its name does not tell."""
    sensor_height: SensorHeight = "auto"
    """How many metres the sensor is above the ground; `estimate` finds it, and the tilt, from the scan, and `auto`
    takes that of the map's last place."""


def relocalize(command: RelocalizeCommand) -> list[Relocated]:
    """Do what the command says; returns the answers, the most probable first."""
    params = load(command.weights)
    places = PlaceMap.load(command.map, weights_hash=weights_hash(params))
    found = places.relocate(params, _record(command, places), candidates=command.candidates)
    if not found:
        raise ValueError(f"{command.scan}: expected a scan that shows something, found one that shows next to nothing")
    if command.out is not None:
        write_json(command.out, [_as_json(one) for one in found])
    console().print(_table(command.scan, found))
    return found


def _record(command: RelocalizeCommand, places: PlaceMap) -> Record:
    if command.scan.suffix == ".png":
        return Record(image=read_image(command.scan))
    record = scan_record(command.scan, format=command.format)
    return dataclasses.replace(record, mounting=_mounting(command, record, places))


def _mounting(command: RelocalizeCommand, record: Record, places: PlaceMap) -> Mounting:
    if command.sensor_height == "auto":
        return places.mounting()
    if command.sensor_height != "estimate":
        return Mounting(float(command.sensor_height))
    assert record.points is not None
    found = estimate_mounting(record.points)
    if found is None:
        raise ValueError(f"{command.scan}: expected ground that tells the sensor's height, found none: say how high")
    return found


def _as_json(found: Relocated) -> dict:
    about = {"place": found.place, "probability": found.probability}
    return {**about, "world_from_query": found.world_from_query.tolist(), "covariance": found.loop.covariance.tolist()}


def _table(scan: Path, found: list[Relocated]) -> Table:
    table = Table("place", "probability", "x [m]", "y [m]", "z [m]", "yaw [deg]", title=f"{scan.name} in the map")
    for one in found:
        pose = one.world_from_query
        yaw = np.degrees(np.arctan2(pose[1, 0], pose[0, 0]))
        table.add_row(one.place, f"{one.probability:.4f}", *(f"{value:.2f}" for value in pose[:3, 3]), f"{yaw:.1f}")
    return table


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(RelocalizeCommand, "relocalize"), relocalize)


if __name__ == "__main__":
    main()
