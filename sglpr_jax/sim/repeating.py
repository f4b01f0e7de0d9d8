"""Simulated drives through surroundings where places repeat, with and without revisits."""

import dataclasses

import numpy as np

from sglpr_jax.sim.drive import VEHICLE, Carrier, PlanarPath, check_drawing, drive_seed, scan_rows, timed
from sglpr_jax.sim.recording import SimulatedRecording, drive_through, random_of
from sglpr_jax.sim.routes import REVISITS, Line, Revisit
from sglpr_jax.sim.sceneries import REPEATING, Repeating
from sglpr_jax.sim.sceneries.site import LAPS, Site, build, way
from sglpr_jax.sim.sensor import HDL64E, Sensor
from sglpr_jax.sim.world import World

SHORTEST_S = 75.0  # minimum duration of a drive, in seconds, over which few scans are spread
LEAST_RANGE_M = 0.5  # highest minimum range of the sensor of a small robot, in metres


def simulate_repeating(
    name: str,
    *,
    scans: int = 300,
    seed: int = 0,
    sensor: Sensor = HDL64E,
    revisit: Revisit = "none",
    rate_hz: float | None = None,
    carrier: Carrier = VEHICLE,
) -> SimulatedRecording:
    """Returns the recording of a drive through surroundings where places repeat.

    Arguments:
      name: Scenery, from `REPEATING`.
      scans: Number of scans, evenly spaced over the drive.
      seed: Seed of the scenery and the drive, at least 0.
      sensor: LiDAR. In sceneries of small robots it is mounted lower and has a minimum range of at most 0.5 m.
      revisit: "none": frames 30 s apart are more than `other_m` apart. "opposite": returns on the same way.
        "same": drives one and a half laps along a closed path.
      rate_hz: Scans per second. None uses the rate of the carrier or of the scenery.
      carrier: Carrier of the sensor, such as one of `CARRIERS`. Slow ones and halts bring frames 30 s apart closer.

    Raises:
      ValueError: The name or `revisit` is unknown, `rate_hz` is not positive, or `seed` is negative.

    Example:
      drive = simulate_repeating("yard", seed=1, revisit="same", carrier=CARRIERS["backpack"])
    """
    if name not in REPEATING:
        raise ValueError(f"expected a scenery among {', '.join(REPEATING)}, found {name!r}")
    if revisit not in REVISITS:
        raise ValueError(f"revisit: expected one of {', '.join(REVISITS)}, found {revisit!r}")
    scenery = REPEATING[name]
    rate_hz = carrier.rate_hz or scenery.rate_hz if rate_hz is None else rate_hz
    check_drawing(rate_hz, seed)
    seeds = drive_seed(seed, f"{name} {revisit}")
    world, path = plan_drive(scenery, seeds, scans=scans, revisit=revisit, rate_hz=rate_hz, carrier=carrier)
    rows = scan_rows(path, scans)
    options = {"name": f"{name}-{revisit}", "sensor": _mounted(sensor, scenery, carrier), "carrier": carrier}
    return drive_through(world, path, rows, **options, **random_of(seeds))


def plan_drive(
    scenery: Repeating,
    seeds: tuple[int, ...],
    *,
    scans: int,
    revisit: Revisit,
    rate_hz: float,
    carrier: Carrier = VEHICLE,
) -> tuple[World, PlanarPath]:
    """Draws a scenery and the drive through it. The number of poses is a multiple of `scans`."""
    rng = np.random.default_rng((*seeds, 1))
    speed = rng.uniform(*(carrier.speed_mps or scenery.speed_mps))
    length = max(scans / rate_hz, SHORTEST_S) * speed / {"none": 1, "opposite": 2, "same": LAPS}[revisit]
    if revisit == "same":  # a lap has room for the scenery even if the carrier is slow
        length = max(length, SHORTEST_S * scenery.speed_mps[0] / LAPS)
    site = scenery.site(rng, length, scenery.is_closed(revisit))
    line = driven_line(rng, site, scenery, revisit)
    path = carrier.halted(rng, timed(rng, line, free_mps=speed, poses=scans), poses=scans)
    return build(site, line, clearance_m=scenery.clearance_m), path


def driven_line(rng: np.random.Generator, site: Site, scenery: Repeating, revisit: Revisit) -> Line:
    """Path along the line of a site."""
    laps = "none" if site.returns and revisit == "same" else revisit
    return way(rng, site.line, laps, right_m=scenery.right_m, sway_m=scenery.sway_m)


def _mounted(sensor: Sensor, scenery: Repeating, carrier: Carrier) -> Sensor:
    """`sensor` with the height and minimum range for the carrier, or for the scenery's vehicle."""
    height_m = scenery.height_m if carrier.height_m is None else carrier.height_m
    if height_m is None:
        return sensor
    return dataclasses.replace(sensor, height_m=height_m, min_range_m=min(LEAST_RANGE_M, sensor.min_range_m))
