"""The training set of the shipped weights: images of towns, seen by several sensors, from several lines and carriers.

Towns with equal seeds are equal, so places have positives by another sensor or from another lane (`Recording.world`).
"""

from collections.abc import Iterator
from typing import Any

IN_BOTH_DIRECTIONS = ("00", "08")
"""Routes with revisits in the same and in the opposite direction."""
ALL_KINDS = ("00", "02", "05", "06", "08")
"""All routes of the leave-one-out towns with revisits."""
TOWNS = range(10, 18)
SEEN_OFTEN = range(10, 14)
"""Towns that other sensors see, too, and from other lanes."""
SENSORS = ("vlp16", "os1-64", "hdl32e")
ASIDE_M = (2.0, 3.5)
SCENERIES = {"outskirts": (20, 21), "lanes": (22, 23), "gardens": (24,)}
"""Sceneries with their seeds."""
ALIKE = {"car_park": {}, "garage": {}, "forest": {"carrier": "backpack", "sensor": "os1-64"}}
"""Sceneries where places look alike, for hard negatives, with options."""


HELD_OUT = "held-out"
"""Name of the dataset on which `bin/train --seq held-out/08` tests, with a town of its own."""


def training_set() -> dict[str, dict[str, Any]]:
    """Return the options of `simulate` for each dataset, by the name of its folder."""
    return {name: {"images": True, **options} for name, options in _datasets()}


def _datasets() -> Iterator[tuple[str, dict[str, Any]]]:
    yield HELD_OUT, {"seed": 37, "routes": ("08",)}
    for seed in TOWNS:
        yield f"town-{seed}", {"seed": seed, "routes": ALL_KINDS}
    for seed in SEEN_OFTEN:
        options = {"seed": seed, "routes": IN_BOTH_DIRECTIONS}
        for sensor in SENSORS:
            yield f"town-{seed}-{sensor}", {**options, "sensor": sensor}
        for aside_m in ASIDE_M:
            yield f"town-{seed}-aside-{aside_m:g}", {**options, "aside_m": aside_m}
        yield f"town-{seed}-walked", {**options, "carrier": "backpack", "sensor": "os1-64"}
        yield f"town-{seed}-thinned", {**options, "vary": True}
    for scenery, seeds in SCENERIES.items():
        for seed in seeds:
            options = {"seed": seed, "scenery": scenery}
            yield f"{scenery}-{seed}", {**options, "routes": ("00", "02", "06", "08")}
            yield f"{scenery}-{seed}-aside-2.5", {**options, "routes": ("02", "08"), "aside_m": 2.5}
            yield f"{scenery}-{seed}-os1-64", {**options, "routes": IN_BOTH_DIRECTIONS, "sensor": "os1-64"}
    for scenery, options in ALIKE.items():
        yield f"{scenery}-11", {"seed": 11, "scenery": scenery, "routes": IN_BOTH_DIRECTIONS, **options}
