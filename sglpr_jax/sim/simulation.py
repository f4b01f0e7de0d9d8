"""Writing of simulated datasets in one call: several towns, one town on several days, and two default datasets."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from sglpr_jax.sim.carriers import CARRIERS
from sglpr_jax.sim.choices import RATE_HZ, SCANS
from sglpr_jax.sim.dataset import VERSION, write_dataset, write_sessions
from sglpr_jax.sim.drive import name_of_path
from sglpr_jax.sim.layouts import LAYOUTS
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.scenery import SCENERIES
from sglpr_jax.sim.sensor import SENSORS, Sensor

ROUTES = ("00", "05", "08")
"""Default routes in towns."""
REVISITED = ("01", "06", "08")
"""Default routes where places repeat: without revisits, in the same and in the opposite direction."""
DAYS = ("2012-01-15", "2012-02-04", "2012-03-17")
AZIMUTH_STEPS = 900
"""Firings per revolution in the default datasets."""
BYTES_PER_RAY = {"scans": 16, "nclt": 5}
"""Approximate size of a scan with its labels, in bytes per ray, by layout.

Layout "scans" stores 20 bytes per return, and most rays return. NCLT stores 8, but many rays go into the sky.
"""
BYTES_PER_IMAGE = 3500
"""Approximate size of an image with its label image, in bytes."""


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Description of a simulated dataset, before or after it is written."""

    root: Path
    names: tuple[str, ...]
    """Names of the recordings."""
    scans: int
    """Maximum number of scans in each recording."""
    layout: str
    """Name of the layout, from `LAYOUTS`."""
    sensor: Sensor

    @property
    def missing(self) -> tuple[str, ...]:
        """Recordings that are not complete."""
        return tuple(name for name in self.names if not LAYOUTS[self.layout].is_finished(self.root, name))

    @property
    def missing_bytes(self) -> int:
        """Approximate size of the missing recordings, in bytes."""
        rays = len(self.sensor.elevations_deg) * self.sensor.azimuth_steps
        each = BYTES_PER_IMAGE if self.layout in ("images", "varied") else BYTES_PER_RAY[self.layout] * rays
        return each * self.scans * len(self.missing)

    def __str__(self) -> str:
        return f"{self.root}: recordings {', '.join(self.names)}"


def simulate(
    out: Path | str,
    *,
    routes: Sequence[str] | None = None,
    along: Sequence[Path] = (),
    sessions: Sequence[str] = (),
    scans: int = SCANS,
    sensor: str | None = None,
    azimuth_steps: int | None = None,
    seed: int = 0,
    rate_hz: float | None = None,
    scenery: str = "town",
    carrier: str = "vehicle",
    submap_m: float = 0.0,
    images: bool = False,
    vary: bool = False,
    on_start: Callable[[Simulated], None] = lambda dataset: None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Simulated:
    """Drives a simulated LiDAR through simulated towns and writes scans, labels and poses.

    The same call completes an interrupted dataset and gives the same bytes. Recordings can be added to a dataset, but
    not sessions.

    Arguments:
      out: Output folder.
      routes: Routes "00" to "10", each with its own town. None drives 00, 05 and 08, or no route if there is `along`.
      along: KITTI pose files to drive along.
      sessions: Dates such as "2012-01-15". One town is driven on each of these days, in NCLT's layout. `routes` may
        then hold one route; None is 00.
      scans: Number of scans of each recording. Along a pose file it is the maximum.
      sensor: Name from `SENSORS`. None is hdl64e, or hdl32e-nclt with `sessions`.
      azimuth_steps: Firings per revolution. None is the sensor's own number.
      seed: Seed of the towns, at least 0.
      rate_hz: Scans per second of a route. None is 4 in towns, elsewhere the rate of the carrier or of the scenery.
      scenery: Name from `SCENERIES` (towns), or from `REPEATING`. In the latter, a route stands only for the direction
        of its revisits.
      carrier: Name from `CARRIERS`. In towns, only its height and sway are used. `sessions` need a vehicle.
      submap_m: Travelled distance of submaps, in metres. 0 writes scans.
      images: Whether to write density images with label images instead of scans.
      vary: Whether the images show scans that are rotated about z, some of them with lost points. See `sim.variety`.
      on_start: Function that is called with the dataset's description after all arguments are checked.
      on_progress: Function that is called with the number of completed scans, counting `scans` for each recording.

    Returns:
      Description of the dataset.

    Raises:
      ValueError: A route, the sensor, the scenery or the carrier is unknown, a pose file is malformed, or arguments
        contradict each other. Or `out` holds another dataset.
      OSError: A file cannot be read or written.

    Example:
      print(sglpr_jax.simulate("towns", routes=["08"], scans=400))
    """
    lidar = _lidar(sensor or ("hdl32e-nclt" if sessions else "hdl64e"), azimuth_steps)
    if sessions and (along or images or len(routes or ()) > 1):
        found = f"{len(routes or ())} routes, {len(along)} pose files, images {images}"
        raise ValueError(f"with sessions, expected at most one route, no pose files and no images, found {found}")
    known = SCENERIES if sessions else {**SCENERIES, **REPEATING}
    if scenery not in known:
        raise ValueError(f"expected a scenery among {', '.join(known)}, found {scenery!r}")
    if carrier not in CARRIERS:
        raise ValueError(f"expected a carrier among {', '.join(CARRIERS)}, found {carrier!r}")
    if sessions and carrier != "vehicle":
        raise ValueError(f"with sessions, expected the carrier vehicle, found {carrier!r}")
    if sessions and submap_m:
        raise ValueError(f"with sessions, expected no submaps, found submaps of {submap_m:g} m")
    chosen = (
        routes if routes is not None else () if along or sessions else ROUTES if scenery in SCENERIES else REVISITED
    )
    names = tuple(sessions) or (*chosen, *map(name_of_path, along))
    if vary and not images:
        raise ValueError("vary: expected images, found scans; vary changes scans before they are converted to images")
    layout = "nclt" if sessions else "varied" if vary else "images" if images else "scans"
    out = Path(out)
    dataset = Simulated(out, names, scans, layout, lidar)
    start = functools.cache(lambda: on_start(dataset))

    def progress(name: str, done: int, count: int) -> None:
        start()  # here, because all arguments are checked before the first progress
        on_progress(names.index(name) * scans + done * scans // count)

    options = {"scans": scans, "sensor": lidar, "seed": seed, "progress": progress}
    if sessions:
        rate_hz = RATE_HZ if rate_hz is None else rate_hz
        town = SCENERIES[scenery]
        write_sessions(out, dates=sessions, route=next(iter(chosen), "00"), rate_hz=rate_hz, scenery=town, **options)
    else:
        options |= {"rate_hz": rate_hz, "scenery": SCENERIES.get(scenery, scenery), "submap_m": submap_m}
        options |= {"carrier": CARRIERS[carrier]}
        write_dataset(out, names=chosen, along=along, layout=layout, **options)
    return dataset


def default_dataset(cache: Path) -> tuple[Path, dict]:
    """Folder below `cache`, and options of `simulate`, for the dataset that is used by default."""
    return _below(cache, "simulated"), {"scans": SCANS, "azimuth_steps": AZIMUTH_STEPS, "seed": 0}


def default_sessions(cache: Path) -> tuple[Path, dict]:
    """Like `default_dataset`, for one town on three days."""
    return _below(cache, "sessions"), {"sessions": DAYS, "scans": SCANS, "azimuth_steps": AZIMUTH_STEPS, "seed": 0}


def _below(cache: Path, kind: str) -> Path:
    return cache / f"{kind}-v{VERSION}-{SCANS}x{AZIMUTH_STEPS}-seed0"


def _lidar(sensor: str, azimuth_steps: int | None) -> Sensor:
    if sensor not in SENSORS:
        raise ValueError(f"expected a sensor among {', '.join(SENSORS)}, found {sensor!r}")
    lidar = SENSORS[sensor]
    return lidar if azimuth_steps is None else dataclasses.replace(lidar, azimuth_steps=azimuth_steps)
