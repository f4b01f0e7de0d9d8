"""Simulated drives by name, and the odometry with which they are searched."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import replacing
from sglpr_jax.se3 import inverse, transform
from sglpr_jax.sim.drive import CARRIERS
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.repeating import simulate_repeating
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
"""In towns, frames farther apart than this show different places."""


class Case(NamedTuple):
    """A simulated drive."""

    world: str
    """Scenery of a town, or scenery that repeats."""
    route: str
    """Route of a town, or its kind of revisits: "none", "same" or "opposite". Sceneries that repeat have only these."""
    seed: int
    sensor: str
    """Name in `LIDARS`, with a plus sign and the name of the carrier if it is not a vehicle."""

    @classmethod
    def of(cls, text: str, *, sensor: str = "hdl64e") -> "Case":
        """The drive WORLD:ROUTE:SEED or WORLD:ROUTE:SEED:SENSOR."""
        world, route, seed, *own = text.split(":")
        return cls(world, route, int(seed), own[0] if own else sensor)

    @property
    def other_m(self) -> float:
        """Frames farther apart than this show different places, in metres."""
        return OTHER_M if self.world in SCENERIES else REPEATING[self.world].other_m

    def simulate(self, *, scans: int, azimuth_steps: int | None, rate_hz: float | None = None) -> SimulatedRecording:
        """The recording. None as `azimuth_steps` keeps those of the sensor."""
        name, _, carrier = self.sensor.partition("+")
        options: dict[str, Any] = {"scans": scans, "seed": self.seed, "sensor": lidar(name, azimuth_steps)}
        options["carrier"] = CARRIERS[carrier or "vehicle"]
        options |= {} if rate_hz is None else {"rate_hz": rate_hz}
        if self.world not in SCENERIES:
            return simulate_repeating(self.world, revisit=self.route, **options)  # type: ignore[arg-type]
        routes = ROUTES.get(self.route, (self.route,))
        return simulate_recording(routes[self.seed % len(routes)], scenery=SCENERIES[self.world], **options)


def lidar(name: str, azimuth_steps: int | None) -> Sensor:
    """A sensor with at most this number of firings a turn, if it turns. Raises ValueError for an unknown one."""
    if name not in LIDARS:
        raise ValueError(f"expected a sensor among {', '.join(LIDARS)}, found {name!r}")
    known = LIDARS[name]
    if azimuth_steps is None or known.pattern != "rings":
        return known
    return dataclasses.replace(known, azimuth_steps=min(azimuth_steps, known.azimuth_steps))


def in_memory(recording: SimulatedRecording, frames: Sequence[int] | np.ndarray | None = None) -> Recording:
    """The recording, with all scans or those of some frames rendered once."""
    chosen = range(len(recording)) if frames is None else frames
    rendered = {recording.paths[i]: recording.points(int(i)) for i in chosen}
    return dataclasses.replace(recording, read=lambda path, labels, lasers: Scan(points=rendered[path]))


def on_disk(recording: SimulatedRecording, folder: Path) -> Recording:
    """The recording, with scans from a folder in KITTI's format. The folder is written unless it exists."""
    if not folder.exists():
        with replacing(folder) as temporary:
            temporary.mkdir(parents=True)
            for i, scan in enumerate(recording.ids):
                recording.render(i)[0].astype("<f4").tofile(temporary / f"{scan}.bin")

    def read(path: Path, labels: Path | None, lasers: bool) -> Scan:
        return Scan(points=np.fromfile(folder / f"{path.name}.bin", "<f4").reshape(-1, 4)[:, :3])

    return dataclasses.replace(recording, read=read, label_paths=())


def recording_of(name: str, records: Sequence[Scan], times: Float[np.ndarray, " n"] | None = None) -> Recording:
    """A recording of scans or images in memory."""
    paths = tuple(Path(f"{i:06d}") for i in range(len(records)))
    found = dict(zip(paths, records, strict=True))
    return Recording(
        name=name,
        ids=tuple(map(str, paths)),
        times=times,
        paths=paths,
        read=lambda path, labels, lasers: found[path],
        on_disk=False,
    )


def odometry_of(kind: Odometry, poses: Float[np.ndarray, "n 4 4"], *, seed: int) -> Float[np.ndarray, "n 4 4"] | None:
    """The true poses, the same with drift (`drifted`), or None."""
    if kind == "none":
        return None
    return poses if kind == "exact" else drifted(poses, seed=seed)


def drifted(poses: Float[np.ndarray, "n 4 4"], *, seed: int, turn_deg: float = 0.5) -> Float[np.ndarray, "n 4 4"]:
    """Odometry of a drive: 1 % too long or short, turned by `turn_deg` every 100 m, both with as much noise again."""
    rng = np.random.default_rng(seed)
    steps = inverse(poses[:-1]) @ poses[1:]
    metres = np.linalg.norm(steps[:, :3, 3], axis=1)
    length = 1 + 0.01 * (rng.choice([-1, 1]) + rng.normal(size=len(steps)))
    turn = np.radians(turn_deg) * (
        rng.choice([-1, 1]) * metres / 100 + rng.normal(size=len(steps)) * np.sqrt(metres / 100)
    )
    found = [np.eye(4)]
    for step, scale, angle in zip(steps, length, turn, strict=True):
        step = step.copy()
        step[:3, 3] *= scale
        found.append(found[-1] @ step @ transform(0.0, 0.0, angle))
    return np.stack(found)


def revisited(
    positions: Float[np.ndarray, "n 3"], progress: Float[np.ndarray, " n"], *, near_m: float, apart: float
) -> Bool[np.ndarray, " n"]:
    """Which scans come within `near_m` of an earlier one. Their progress, a time or travelled distance, differs by at
    least `apart`."""
    found = np.zeros(len(positions), bool)
    for i, position in enumerate(positions):
        old = positions[progress <= progress[i] - apart]
        found[i] = len(old) > 0 and np.linalg.norm(old - position, axis=1).min() < near_m
    return found
