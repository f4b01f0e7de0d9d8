"""One town on several days, the parts of one long drive: other parked cars, traffic and paths each day."""

import datetime
import functools
from collections.abc import Sequence

import numpy as np

from sglpr_jax.sim import RATE_HZ
from sglpr_jax.sim.drive import check_drawing, drive_seed, plan_path
from sglpr_jax.sim.layouts import to_utime
from sglpr_jax.sim.recording import PlannedRecording, SimulatedRecording, drive_through, random_of
from sglpr_jax.sim.sensor import SENSORS, Sensor
from sglpr_jax.sim.styles import TOWN, Scenery
from sglpr_jax.sim.world import build_world

PAUSE_S = 1800.0  # pause between two days, in seconds: three times the mean stay of a parked car
START_H = 12  # hour (UTC) at which each session starts


def plan_sessions(
    dates: Sequence[str],
    *,
    route: str = "00",
    scans: int = 300,
    sensor: Sensor = SENSORS["hdl32e-nclt"],
    seed: int = 0,
    rate_hz: float = RATE_HZ,
    scenery: Scenery = TOWN,
) -> tuple[PlannedRecording, ...]:
    """Plans one session for each date. The town is built when the first session is simulated.

    The first session drives `route`, the others the same streets in another order, partly in the opposite direction. As
    in NCLT, times are seconds since 1970, and ids are these times in microseconds. Other arguments and errors are as in
    `simulate_recording`.

    Raises:
      ValueError: A date is invalid or repeated, or there are no dates. Or `scans` is below 2.
    """
    check_drawing(rate_hz, seed)
    starts = [_start_of(date) for date in dates]
    if len(set(dates)) < max(len(dates), 1) or scans < 2:
        raise ValueError(f"expected different dates and 2 scans or more, found {', '.join(dates) or 'none'}; {scans}")
    seeds, days = drive_seed(seed, f"sessions {route}"), len(dates)
    path = plan_path(np.random.default_rng((*seeds, 1)), route, scans=scans, rate_hz=rate_hz, days=days)
    path = path._replace(times=path.times + PAUSE_S * (np.arange(len(path.times)) * days // len(path.times)))
    town = functools.cache(lambda: build_world(seeds, path.xy, path.times, scenery=scenery))

    def plan(day: int, rows: np.ndarray) -> PlannedRecording:
        times = starts[day] + path.times[rows] - path.times[rows[0]]
        ids = tuple(str(to_utime(time)) for time in times.tolist())

        def simulate() -> SimulatedRecording:
            options = {"name": dates[day], "ids": ids, "times": times, "sensor": sensor}
            return drive_through(town(), path, rows, **options, **random_of((*seeds, day)))

        return PlannedRecording(dates[day], ids, simulate)

    rows = np.arange(0, len(path.times), len(path.times) // (scans * days))
    return tuple(plan(day, rows_of_day) for day, rows_of_day in enumerate(np.split(rows, days)))


def _start_of(date: str) -> float:
    """Start of a session, in seconds since 1970. Raises ValueError if the date is invalid."""
    try:
        day = datetime.datetime.strptime(date, "%Y-%m-%d")
    except ValueError as error:
        raise ValueError(f"expected dates such as 2012-01-15, found {date!r}") from error
    return day.replace(hour=START_H, tzinfo=datetime.UTC).timestamp()
