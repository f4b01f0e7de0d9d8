"""Simulated drives of the benchmarks, their scans in memory or on disk, and their odometry."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.formats.pose_files import read_kitti
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import replacing
from sglpr_jax.revisits import has_near
from sglpr_jax.se3 import inverse, transform
from sglpr_jax.sim.drive import CARRIERS
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording, simulate_repeating
from sglpr_jax.sim.routes import REVISITS
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.sensor import HDL64E, SENSORS, Sensor
from sglpr_jax.sim.styles import SCENERIES

Odometry = Literal["none", "exact", "drifting"]
ROUTES = {"none": ("01", "04"), "same": ("06", "00"), "opposite": ("08",)}
"""Routes of the towns with each kind of revisits. The seed chooses one."""
HIDDEN_DEG = (60.0, 300.0, 91.0)
"""Azimuths that a sensor of 120 degrees does not see, and the elevation below which they are hidden."""
LIDARS = {
    **SENSORS,
    "hdl64e-120": dataclasses.replace(HDL64E, shadows_deg=(HIDDEN_DEG,)),
    "os0-32-140": dataclasses.replace(SENSORS["os0-32"], azimuths_deg=(-70.0, 70.0)),
}
OTHER_M = 20.0
"""Distance above which two frames of a town show different places, in metres."""
STEPS = {"hdl64e": 900, "hdl32e": 1080}
"""Default firings per turn. The default of other sensors is the sensor's own number."""
CARS = (("hdl64e", "vehicle"), ("vlp16", "vehicle"))
WALKERS = (("os0-32", "backpack"), ("os0-32-140", "handheld"))
MOUNTED = {
    **dict.fromkeys(("hall", "yard"), WALKERS),
    **dict.fromkeys(("campus", "warehouse"), (*CARS, ("os0-32", "cart"))),
    "forest": (*CARS, ("os0-32", "backpack")),
    "storeys": (("hdl32e", "vehicle"), ("vlp16", "vehicle")),
}
"""Sensors and carriers of a scenery, if they are not `CARS`."""


class Drive(NamedTuple):
    """A simulated drive."""

    world: str
    """Name of a scenery: of a town (`SCENERIES`), or where places repeat (`REPEATING`)."""
    route: str
    """Kind of revisits: "none", "same" or "opposite". Towns also accept a route, such as "08"."""
    seed: int
    sensor: str
    carrier: str

    @property
    def name(self) -> str:
        """Name of its files."""
        return "-".join(map(str, self))

    @property
    def other_m(self) -> float:
        """Distance above which two frames show different places, in metres."""
        return OTHER_M if self.world in SCENERIES else REPEATING[self.world].other_m


@dataclasses.dataclass(frozen=True)
class Drives:
    """Drives of a benchmark: each world with each route, seed, sensor and carrier."""

    drives: tuple[str, ...] = ()
    """WORLD:ROUTE:SEED, instead of `world`, `route` and `seed`."""
    world: tuple[str, ...] = (*REPEATING, *SCENERIES)
    """Sceneries that repeat, and sceneries of towns."""
    route: tuple[str, ...] = REVISITS
    """Kinds of revisits: none, same or opposite. Towns also have routes: 00 has revisits in the same direction, 08 in
    the opposite one."""
    seed: tuple[int, ...] = (1,)
    sensor: tuple[str, ...] = ()
    """Names of sensors. Without them, sensors and carriers are those of the scenery."""
    carrier: tuple[str, ...] = ("vehicle",)
    scans: int = 300
    azimuth_steps: int | None = 900
    """Maximum number of firings of a sensor per turn. None: 900 of hdl64e, 1080 of hdl32e, all of others."""
    rate_hz: float | None = None
    """Scans per second. None: the rate of the carrier or of the scenery."""

    def __iter__(self) -> Iterator[Drive]:
        """Yields all drives: world, route and seed, each with all sensors and carriers."""
        combinations = [text.split(":") for text in self.drives]
        if not combinations:
            product = itertools.product(self.seed, self.route, self.world)
            combinations = [[world, route, seed] for seed, route, world in product]
        for world, route, seed in combinations:
            sensors_and_carriers = tuple(itertools.product(self.sensor, self.carrier)) or MOUNTED.get(world, CARS)
            for sensor, carrier in sensors_and_carriers:
                yield Drive(world, route, int(seed), sensor, carrier)

    def simulate(self, drive: Drive, *, scans: int | None = None) -> SimulatedRecording:
        """Returns the recording of a drive, with `scans` scans if given."""
        steps = STEPS.get(drive.sensor) if self.azimuth_steps is None else self.azimuth_steps
        options: dict[str, Any] = {
            "scans": scans or self.scans,
            "seed": drive.seed,
            "sensor": lidar(drive.sensor, steps),
        }
        options["carrier"] = CARRIERS[drive.carrier]
        options |= {} if self.rate_hz is None else {"rate_hz": self.rate_hz}
        if drive.world not in SCENERIES:
            return simulate_repeating(drive.world, revisit=drive.route, **options)  # type: ignore[arg-type]
        routes = ROUTES.get(drive.route, (drive.route,))
        return simulate_recording(routes[drive.seed % len(routes)], scenery=SCENERIES[drive.world], **options)


EVERYWHERE = Drives()
WALKS = Drives(
    drives=("town:08:620", "town:00:621", "outskirts:06:622", "gardens:08:623"),
    sensor=("hdl64e",),
    carrier=("handheld",),
    scans=360,
    azimuth_steps=None,
)
"""Walks through towns with a sensor in the hand."""


def lidar(name: str, azimuth_steps: int | None) -> Sensor:
    """Sensor of this name from `LIDARS`. A rotating sensor has at most `azimuth_steps` firings per turn.

    Raises ValueError if the name is unknown.
    """
    if name not in LIDARS:
        raise ValueError(f"expected a sensor among {', '.join(LIDARS)}, found {name!r}")
    sensor = LIDARS[name]
    if azimuth_steps is None or sensor.pattern != "rings":
        return sensor
    return dataclasses.replace(sensor, azimuth_steps=min(azimuth_steps, sensor.azimuth_steps))


def in_memory(recording: SimulatedRecording, frames: Sequence[int] | np.ndarray | None = None) -> Recording:
    """Renders the scans of `frames`, by default of all, and returns the recording with only these scans, unlabelled."""
    frames = range(len(recording)) if frames is None else frames
    points = {recording.paths[i]: recording.points(int(i)) for i in frames}
    return dataclasses.replace(recording, read=lambda path, labels: Scan(points=points[path]))


def on_disk(recording: SimulatedRecording, folder: Path) -> Recording:
    """Returns the recording with scans from a folder in KITTI's format, unlabelled. Writes a missing folder first."""
    if not folder.exists():
        with replacing(folder) as temporary:
            temporary.mkdir(parents=True)
            for i, scan in enumerate(recording.ids):
                recording.render(i)[0].astype("<f4").tofile(temporary / f"{scan}.bin")

    def read(path: Path, labels: Path | None) -> Scan:
        return Scan(points=np.fromfile(folder / f"{path.name}.bin", "<f4").reshape(-1, 4)[:, :3])

    return dataclasses.replace(recording, read=read, label_paths=())


def ready_made(data: Path, name: str) -> tuple[Recording, Float[np.ndarray, "n 4 4"]]:
    """Returns a recording of ready-made images, in the layout NN/imgs/*.png, and its poses from NN/pose.txt."""
    recording = open_recording(data, name)
    poses = read_kitti(data / name / "pose.txt", camera=False)
    return recording, poses[[int(frame) for frame in recording.ids]]


def recording_of(name: str, scans: Sequence[Scan], times: Float[np.ndarray, " n"] | None = None) -> Recording:
    """Returns a recording of scans or images in memory."""
    paths = tuple(Path(f"{i:06d}") for i in range(len(scans)))
    scan_of = dict(zip(paths, scans, strict=True))
    return Recording(
        name=name,
        ids=tuple(map(str, paths)),
        times=times,
        paths=paths,
        read=lambda path, labels: scan_of[path],
        on_disk=False,
    )


def odometry_of(kind: Odometry, poses: Float[np.ndarray, "n 4 4"], *, seed: int) -> Float[np.ndarray, "n 4 4"] | None:
    """Odometry from true poses: None, the same poses ("exact"), or poses with drift ("drifting", see `drifted`)."""
    if kind == "none":
        return None
    return poses if kind == "exact" else drifted(poses, seed=seed)


def drifted(poses: Float[np.ndarray, "n 4 4"], *, seed: int, turn_deg: float = 0.5) -> Float[np.ndarray, "n 4 4"]:
    """Odometry of a drive: 1 % too long or short, and rotated by `turn_deg` every 100 m, both with noise.

    The noise has a standard deviation of 1 % of each step, and of `turn_deg` over 100 m.
    """
    rng = np.random.default_rng(seed)
    steps = inverse(poses[:-1]) @ poses[1:]
    metres = np.linalg.norm(steps[:, :3, 3], axis=1)
    scales = 1 + 0.01 * (rng.choice([-1, 1]) + rng.normal(size=len(steps)))
    bias = rng.choice([-1, 1]) * metres / 100
    angles = np.radians(turn_deg) * (bias + rng.normal(size=len(steps)) * np.sqrt(metres / 100))
    odometry = [np.eye(4)]
    for step, scale, angle in zip(steps, scales, angles, strict=True):
        step = step.copy()
        step[:3, 3] *= scale
        odometry.append(odometry[-1] @ step @ transform(0.0, 0.0, angle))
    return np.stack(odometry)


def is_revisit(
    positions: Float[np.ndarray, "n 3"], progress: Float[np.ndarray, " n"], *, near_m: float, min_progress: float
) -> Bool[np.ndarray, " n"]:
    """Whether each scan is within `near_m` of an earlier scan whose progress is at least `min_progress` less.

    The progress is a time, frame number or travelled distance, and never decreases.
    """
    ends = np.searchsorted(progress, progress - min_progress, side="right")
    return has_near(positions, positions, ends, lambda metres: metres < near_m)
