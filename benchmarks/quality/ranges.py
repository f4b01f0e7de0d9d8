"""How far a sensor sees in each scenery that repeats and in a town, and the scale that `--scale auto` would choose.

python -m benchmarks.quality.ranges --sensors vlp16 --seeds 11 12
"""

import dataclasses

import tyro

from sglpr_jax.data.scaled import chosen_scale, typical_range_m
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.repeating import simulate_repeating
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.sensor import SENSORS


def main(*, sensors: tuple[str, ...] = ("vlp16", "hdl64e"), seeds: tuple[int, ...] = (11, 12)) -> None:
    """Print the ranges.

    Args:
        sensors: names of simulated sensors.
        seeds: one drive of 40 scans for each.
    """
    for name in sensors:
        sensor = dataclasses.replace(SENSORS[name], azimuth_steps=300)
        for scenery in (*REPEATING, "town"):
            make, first = (simulate_repeating, scenery) if scenery in REPEATING else (simulate_recording, "00")
            drives = [make(first, scans=40, seed=seed, sensor=sensor) for seed in seeds]
            said = ", ".join(f"{typical_range_m(drive):.1f} m, scale {chosen_scale(drive)}" for drive in drives)
            print(f"{name} {scenery}: {said}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
