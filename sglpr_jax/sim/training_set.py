"""Training set of the preset `sglpr`: images of towns and other sceneries, by many sensors.

Datasets of one town have equal seeds, so its places have positives by another sensor, from another lane and of another
carrier (`Recording.world`).
"""

from collections.abc import Iterator
from typing import Any

from sglpr_jax.sim.sceneries import REPEATING

TOWNS, SEEN_OFTEN = range(10, 18), range(10, 14)
"""Seeds of all towns, and of the towns that other sensors see, too."""
SCENERIES = {"outskirts": (20, 21), "lanes": (22, 23), "gardens": (24, 25)}
"""Other sceneries without repeating places, with their seeds."""
MOST_ROUTES, BOTH_DIRECTIONS = ("00", "02", "05", "06", "08"), ("00", "08")
"""Routes with revisits, and two of them, with revisits in the same and in the opposite direction."""
SENSORS = ("vlp16", "os1-64", "hdl32e", "xt32", "os0-32", "hdl32e-nclt", "mid360", "hdl64e")
"""Sensors of the repeating sceneries, in turn. The first three see towns, too."""
ASIDE_M = (2.0, 3.5)
"""Distances from the usual line, in metres, as on another lane."""
HELD_OUT = "held-out"
"""Dataset with a town of its own, for `bin/train --seq held-out/08`."""
FIRINGS = 900
"""Azimuth steps of all sensors. At 25 m, the end of the image, rays are 0.17 m apart, less than a cell of 0.4 m."""


def training_set() -> dict[str, dict[str, Any]]:
    """Return the options of `simulate` for each dataset, by the name of its folder."""
    return {name: {"images": True, "azimuth_steps": FIRINGS, **options} for name, options in _datasets()}


def _datasets() -> Iterator[tuple[str, dict[str, Any]]]:
    yield HELD_OUT, {"seed": 37, "routes": ("08",)}
    for seed in TOWNS:
        yield f"town-{seed}", {"seed": seed, "routes": MOST_ROUTES}
    for seed in SEEN_OFTEN:
        town = {"seed": seed, "routes": BOTH_DIRECTIONS}
        for sensor in SENSORS[:3]:
            yield f"town-{seed}-{sensor}", {**town, "sensor": sensor}
        for aside_m in ASIDE_M:
            yield f"town-{seed}-aside-{aside_m:g}", {**town, "aside_m": aside_m}
        yield f"town-{seed}-walked", {**town, "carrier": "backpack", "sensor": "os1-64"}
        yield f"town-{seed}-varied", {**town, "vary": True}
    for scenery, seeds in SCENERIES.items():
        for seed in seeds:
            surroundings = {"seed": seed, "scenery": scenery}
            yield f"{scenery}-{seed}", {**surroundings, "routes": ("00", "02", "06", "08")}
            yield f"{scenery}-{seed}-aside-2.5", {**surroundings, "routes": ("02", "08"), "aside_m": 2.5}
            yield f"{scenery}-{seed}-varied", {**surroundings, "routes": BOTH_DIRECTIONS, "vary": True}
    for number, scenery in enumerate(REPEATING):
        drive = {"scenery": scenery, "seed": 30, "sensor": SENSORS[number % len(SENSORS)]}
        yield f"{scenery}-30", {**drive, "routes": BOTH_DIRECTIONS, "vary": number % 2 == 1}
