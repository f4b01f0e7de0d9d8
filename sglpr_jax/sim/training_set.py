"""Training set of the preset `sglpr`: images of towns and other sceneries, by many sensors.

Datasets of one scenery and seed show the same worlds, so their places have positives by another sensor, from another
lane and of another carrier (`Recording.world`).
"""

from collections.abc import Iterator
from typing import Any

from sglpr_jax.sim.sceneries import REPEATING

SEEDS = {
    "town": range(1000, 1032),
    "outskirts": range(1000, 1008),
    "lanes": range(1000, 1008),
    "gardens": range(1000, 1008),
}
"""Seeds of the sceneries without repeating places."""
REPEATING_SEEDS, HELD_OUT_SEED = (1000, 1001), 1100
HELD_OUT = "held-out"
"""Dataset with a town of its own, for `bin/train --seq held-out/08`."""
MOST_ROUTES, BOTH_DIRECTIONS = ("00", "02", "05", "06", "08"), ("00", "08")
"""Routes with revisits, and two of them, with revisits in the same and in the opposite direction."""
VARIANTS: tuple[dict[str, Any], ...] = (
    {"aside_m": 2.0},
    {"sensor": "vlp16"},
    {"vary": True},
    {"aside_m": 3.5},
    {"sensor": "os1-64"},
    {"sensor": "os1-64", "carrier": "backpack"},
    {"sensor": "hdl32e"},
)
"""Other views of a world. Each seed has two of them, in turn."""
REPEATING_SENSORS = ("vlp16", "os1-64", "hdl32e", "xt32", "os0-32", "hdl32e-nclt", "mid360", "hdl64e")
"""Sensors of the repeating sceneries, in turn."""
FIRINGS = 900
"""Azimuth steps of all sensors. At 25 m, the end of the image, rays are 0.17 m apart, less than a cell of 0.4 m."""


def training_set() -> dict[str, dict[str, Any]]:
    """Return the options of `simulate` for each dataset, by the name of its folder."""
    return {name: {"images": True, "azimuth_steps": FIRINGS, **options} for name, options in _datasets()}


def _datasets() -> Iterator[tuple[str, dict[str, Any]]]:
    yield HELD_OUT, {"seed": HELD_OUT_SEED, "routes": ("08",)}
    for scenery, seeds in SEEDS.items():
        for seed in seeds:
            world = {"scenery": scenery, "seed": seed}
            yield f"{scenery}-{seed}", {**world, "routes": MOST_ROUTES}
            for variant in (VARIANTS[seed % len(VARIANTS)], VARIANTS[(seed + 3) % len(VARIANTS)]):
                yield f"{scenery}-{seed}-{_name(variant)}", {**world, "routes": BOTH_DIRECTIONS, **variant}
    for seed in REPEATING_SEEDS:
        for number, scenery in enumerate(REPEATING, start=seed):  # the next seed has the next sensor
            drive = {"sensor": REPEATING_SENSORS[number % len(REPEATING_SENSORS)], "vary": number % 2 == 1}
            yield f"{scenery}-{seed}", {"scenery": scenery, "seed": seed, "routes": BOTH_DIRECTIONS, **drive}


def _name(variant: dict[str, Any]) -> str:
    """Name of another view: its carrier, sensor or distance from the usual line."""
    if "aside_m" in variant:
        return f"aside-{variant['aside_m']:g}"
    return variant.get("carrier", variant.get("sensor", "varied"))
