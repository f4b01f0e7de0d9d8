"""bin/relocalize: find the pose of a scan in a map."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from sglpr_jax.cli.recording import OdometrySubmapOptions, RecordingOptions
from sglpr_jax.cli.runtime import console
from sglpr_jax.data.choices import Scale
from sglpr_jax.fields import CountOrZero
from sglpr_jax.loops.config import CANDIDATES, MIN_PROBABILITY, PlaceCount
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.same_place import NEGATIVE_M

if TYPE_CHECKING:
    from sglpr_jax.maps.place_map import Relocalization


@dataclasses.dataclass(frozen=True)
class RelocalizeCommand:
    """Find the pose of a scan in a map of bin/map, with its probability.

    Other answers follow only if they are more than 20 m (divided by the scale of the map) from every more probable one.
    They share the probability: if several places fit equally well, none of them is probable.

    Without --frame, --sensor-height auto takes the mounting of the map's last place. If the sensor of the map tilts,
    the mounting is estimated from the ground in the scan.

    Example:
      bin/relocalize my_scans/000003.bin --map town.safetensors
      bin/relocalize my_scans/000003.bin --map town.safetensors --out pose.json
      bin/relocalize drive.mcap --frame 12 --map town.safetensors
      bin/relocalize drive.mcap --frame 12 --submap-m 10 --map town.safetensors
    """

    scan: Annotated[Path, tyro.conf.Positional]
    """A scan (.bin, .pcd, .ply, .npy, .npz, .las) or a ready-made image (.png). With --frame, a recording: a dataset, a
    bag or a folder of scans."""
    map: Path
    """Map of bin/map."""
    frame: CountOrZero | None = None
    """Number of the scan in the recording, from 0."""
    out: Path | None = None
    """JSON file for the answers, the most probable first: place, probability, world_from_query (4 x 4), covariance."""
    candidates: PlaceCount = CANDIDATES
    """Number of the most similar places of the map that the scan is compared with."""
    weights: str = DEFAULT_WEIGHTS
    """Weights that the map was made with."""
    source: tyro.conf.OmitArgPrefixes[RecordingOptions] = RecordingOptions()
    scale: Scale | None = None
    """Scale that the map must have (--scale of bin/map). By default, the scale of the map is used."""
    submap: tyro.conf.OmitArgPrefixes[OdometrySubmapOptions] = OdometrySubmapOptions()


def relocalize(command: RelocalizeCommand) -> None:
    from sglpr_jax.files import check_writable, naming, write_json  # slow imports, not needed for --help
    from sglpr_jax.maps.place_map import PlaceMap
    from sglpr_jax.maps.query import query_of, read_query
    from sglpr_jax.models.weights import weights_hash
    from sglpr_jax.models.weights_file import load

    if command.out is not None:
        check_writable(command.out)
    unused = command.submap.flag or (command.submap.odometry and "--odometry") or _recording_flag(command.source)
    if command.frame is None and unused:
        raise ValueError(f"{command.scan}: expected --frame with {unused}, found a single scan")
    params = load(command.weights)
    place_map = PlaceMap.load(command.map, weights_hash=weights_hash(params))
    with naming(command.map):
        place_map.index.check(scale=command.scale)
    name = command.scan.name
    if command.frame is None:
        source = command.source
        scan = read_query(command.scan, place_map, format=source.format, sensor_height=source.sensor_height)
    else:
        recording = command.submap.open(command.source, command.scan)
        scan, name = query_of(recording, command.frame), f"frame {command.frame} of {name}"
    answers = place_map.relocate(params, scan, candidates=command.candidates)
    if not answers:
        raise ValueError(f"{name}: expected a scan that shows a place, found an almost empty one")
    if command.out is not None:
        values = [
            {
                "place": answer.place,
                "probability": answer.probability,
                "world_from_query": answer.world_from_query.tolist(),
                "covariance": answer.loop.covariance.tolist(),
            }
            for answer in answers
        ]
        write_json(command.out, values)
    console().print(_answer_table(name, answers, apart_m=NEGATIVE_M / place_map.scale))


def _recording_flag(source: RecordingOptions) -> str | None:
    """Return the first stated flag that has no effect on a single scan, or None."""
    defaults = vars(RecordingOptions())
    unused = (name for name in defaults if name not in ("format", "sensor_height"))
    stated = (f"--{name.replace('_', '-')}" for name in unused if getattr(source, name) != defaults[name])
    return next(stated, None)


def _answer_table(name: str, answers: "list[Relocalization]", *, apart_m: float) -> Table:
    title = escape(f"{name} in the map")  # rich interprets brackets as styles
    notes = [f"The answers are more than {apart_m:g} m apart and exclude each other."] if len(answers) > 1 else []
    if answers[0].probability < MIN_PROBABILITY:
        notes.append(f"Uncertain, because no answer has a probability of {MIN_PROBABILITY:g} or more.")
    caption = " ".join(notes) or None
    table = Table("place", "probability", "x [m]", "y [m]", "z [m]", "yaw [deg]", title=title, caption=caption)
    for answer in answers:
        pose = answer.world_from_query
        position = (f"{value:.2f}" for value in pose[:3, 3])
        yaw_deg = math.degrees(math.atan2(pose[1, 0], pose[0, 0]))
        table.add_row(escape(answer.place), f"{answer.probability:.4f}", *position, f"{yaw_deg:.1f}")
    return table
