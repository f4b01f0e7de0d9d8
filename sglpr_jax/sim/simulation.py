"""Simulated datasets in one call: several towns, one town on several days, and the two that stand in for real ones."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from sglpr_jax.sim.choices import RATE_HZ, SCANS
from sglpr_jax.sim.dataset import VERSION, write_dataset, write_sessions
from sglpr_jax.sim.drive import name_of_path
from sglpr_jax.sim.layouts import LAYOUTS
from sglpr_jax.sim.scenery import SCENERIES
from sglpr_jax.sim.sensor import SENSORS, Sensor

ROUTES = ("00", "05", "08")
"""The routes that are driven where none is named."""
DAYS = ("2012-01-15", "2012-02-04", "2012-03-17")
AZIMUTH_STEPS = 900
"""Firings per turn of the datasets that stand in for real ones."""
BYTES_PER_RAY = {"scans": 16, "nclt": 5}
"""Of a scan and its labels: 20 for every return, and most rays return; of NCLT's 8, but many rays go into the sky."""
BYTES_PER_IMAGE = 3500
"""With its label image."""


@dataclasses.dataclass(frozen=True)
class Simulated:
    """A dataset to be written, or written: what it will hold and how large it is."""

    root: Path
    names: tuple[str, ...]
    """Of its recordings."""
    scans: int
    """Of each of them, at most."""
    layout: str
    """See `LAYOUTS`."""
    sensor: Sensor

    @property
    def missing(self) -> tuple[str, ...]:
        """The recordings that are not finished."""
        return tuple(name for name in self.names if not LAYOUTS[self.layout].is_finished(self.root, name))

    @property
    def missing_bytes(self) -> int:
        """About how much there is to write."""
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
    rate_hz: float = RATE_HZ,
    scenery: str = "town",
    images: bool = False,
    vary: bool = False,
    on_start: Callable[[Simulated], None] = lambda dataset: None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Simulated:
    """Drive a simulated LiDAR through simulated towns; write scans, labels and poses into the folder `out`.

    `routes` are of 00 to 10 (None: 00, 05 and 08, or none with `along`), each through a town of its own; `along` are
    KITTI pose files to drive along. With `sessions`, dates, one town is driven through on so many days, along one
    route, in NCLT's layout. `sensor` is one of `SENSORS` (None: hdl64e, or hdl32e-nclt for sessions), `azimuth_steps`
    its firings per turn. `rate_hz` is scans per second of a route, `scenery` one of `SCENERIES`. `images` writes
    density images with label images in place of scans; with `vary` these are of scans rotated about z, some of them
    with points lost (`sim/variety.py`). An interrupted dataset is completed, to the same bytes, and recordings can be
    added.

    `on_start` is told what there is to write, once it is known that it can be, `on_progress` how many of its scans are
    done, counting `scans` a recording. Raises ValueError for an unknown route or sensor, a malformed pose file, and
    where `out` holds another dataset; OSError where something cannot be written.

    Example:
      print(sglpr_jax.simulate("towns", routes=["08"], scans=400))
    """
    lidar = _lidar(sensor or ("hdl32e-nclt" if sessions else "hdl64e"), azimuth_steps)
    if sessions and (along or images or len(routes or ()) > 1):
        found = f"{len(routes or ())} routes, {len(along)} pose files, images {images}"
        raise ValueError(f"expected at most one route beside sessions, no pose files and no images, found {found}")
    if scenery not in SCENERIES:
        raise ValueError(f"expected a scenery among {', '.join(SCENERIES)}, found {scenery!r}")
    chosen = routes if routes is not None else () if along or sessions else ROUTES
    names = tuple(sessions) or (*chosen, *map(name_of_path, along))
    if vary and not images:
        raise ValueError("vary changes scans before they become images: expected images with it, found scans")
    layout = "nclt" if sessions else "varied" if vary else "images" if images else "scans"
    out = Path(out)
    dataset = Simulated(out, names, scans, layout, lidar)
    start = functools.cache(lambda: on_start(dataset))

    def progress(name: str, done: int, count: int) -> None:
        start()  # not before: by the first progress all that was asked for has been checked
        on_progress(names.index(name) * scans + done * scans // count)

    options = {"scans": scans, "sensor": lidar, "seed": seed, "rate_hz": rate_hz, "scenery": SCENERIES[scenery]}
    if sessions:
        write_sessions(out, dates=sessions, route=next(iter(chosen), "00"), progress=progress, **options)
    else:
        write_dataset(out, names=chosen, along=along, layout=layout, progress=progress, **options)
    return dataset


def default_dataset(cache: Path) -> tuple[Path, dict]:
    """The folder below `cache`, and the options of `simulate`, of the dataset used where none is named."""
    return _below(cache, "simulated"), {"scans": SCANS, "azimuth_steps": AZIMUTH_STEPS, "seed": 0}


def default_sessions(cache: Path) -> tuple[Path, dict]:
    """As `default_dataset`: one town on three days."""
    return _below(cache, "sessions"), {"sessions": DAYS, "scans": SCANS, "azimuth_steps": AZIMUTH_STEPS, "seed": 0}


def _below(cache: Path, kind: str) -> Path:
    return cache / f"{kind}-v{VERSION}-{SCANS}x{AZIMUTH_STEPS}-seed0"


def _lidar(sensor: str, azimuth_steps: int | None) -> Sensor:
    if sensor not in SENSORS:
        raise ValueError(f"expected a sensor among {', '.join(SENSORS)}, found {sensor!r}")
    lidar = SENSORS[sensor]
    return lidar if azimuth_steps is None else dataclasses.replace(lidar, azimuth_steps=azimuth_steps)
