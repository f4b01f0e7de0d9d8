"""Sceneries where different places look alike, by name, with parameters of the drives through them."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from sglpr_jax.sim.objects import Range
from sglpr_jax.sim.routes import Revisit
from sglpr_jax.sim.sceneries.estates import campus, row_houses, slabs
from sglpr_jax.sim.sceneries.indoor import corridor, indoor, rooms
from sglpr_jax.sim.sceneries.nature import field, forest
from sglpr_jax.sim.sceneries.parking import car_park, garage, storeys
from sglpr_jax.sim.sceneries.roads import LANE_M, bridge, highway, tunnel, walls
from sglpr_jax.sim.sceneries.rows import orchard, solar, terminal, vineyard, warehouse
from sglpr_jax.sim.sceneries.site import Site
from sglpr_jax.sim.sceneries.walled import hall, yard


@dataclasses.dataclass(frozen=True)
class Repeating:
    """Scenery where different places look alike, and parameters of the drive through it."""

    site: Callable[[np.random.Generator, float, bool], Site]
    """Function of a random generator, the line's length in metres, and whether it is closed. It draws the scenery."""
    speed_mps: Range  # range of the speed, in m/s
    rate_hz: float = 4.0  # scans per second
    other_m: float = 20.0
    """Distance above which two frames show different places, in metres.

    Without revisits, all frames 30 s apart are farther apart than this.
    """
    clearance_m: float = 1.2  # minimum horizontal distance of standing objects from the path, in metres
    right_m: float = 0.4  # distance of the path to the right of the middle of the road or aisle, in metres
    sway_m: float = 0.3
    """Maximum deviation from `right_m`, in metres. The deviation varies along the path."""
    height_m: float | None = None
    """Height of the sensor above the ground, in metres. None uses the height of the given sensor."""
    crosses: bool = False
    """Whether the line is also closed for revisits in the opposite direction. Such a line crosses itself."""

    def is_closed(self, revisit: Revisit) -> bool:
        """Whether the line of a drive with these revisits is closed."""
        return revisit == "same" or (self.crosses and revisit == "opposite")


_walked = functools.partial(
    Repeating, rate_hz=2.0, clearance_m=0.5, right_m=0.1, sway_m=0.2, height_m=1.5, crosses=True
)
_robot = functools.partial(Repeating, rate_hz=2.0, clearance_m=0.4, right_m=0.2, sway_m=0.15, height_m=0.5)
_rooms = functools.partial(_robot, speed_mps=(0.45, 0.7), other_m=4.0, right_m=0.0, sway_m=0.05)
REPEATING = {
    "walls": Repeating(walls, (8.0, 12.0)),
    "highway": Repeating(highway, (15.0, 20.0), right_m=LANE_M / 2),
    "tunnel": Repeating(tunnel, (8.0, 14.0)),
    "car_park": Repeating(car_park, (4.0, 7.0)),
    "garage": Repeating(garage, (3.0, 5.0), other_m=9.0),
    "corridor": _robot(corridor, (0.5, 1.0), other_m=5.0),
    "rooms_equal": _rooms(functools.partial(rooms, equal=True)),
    "rooms": _rooms(functools.partial(rooms, equal=False)),
    "indoor": _robot(indoor, (0.8, 1.2), other_m=5.0, right_m=0.1, sway_m=0.1),
    "warehouse": _robot(warehouse, (1.0, 1.6), other_m=4.0, height_m=1.0),
    "orchard": Repeating(orchard, (3.5, 6.0), clearance_m=0.5, right_m=0.2, sway_m=0.15),
    "vineyard": Repeating(vineyard, (3.5, 6.0), clearance_m=0.8, right_m=0.2, sway_m=0.15),
    "row_houses": Repeating(row_houses, (6.0, 9.0), right_m=0.2, sway_m=0.2),
    "field": Repeating(field, (7.0, 12.0)),
    "campus": _robot(campus, (1.1, 1.7), rate_hz=1.0, right_m=0.5, height_m=0.6),
    "forest": Repeating(forest, (1.0, 1.6), rate_hz=1.0, clearance_m=0.6, right_m=0.2, sway_m=0.3, height_m=1.6),
    "yard": _walked(yard, (1.1, 1.5)),
    "hall": _walked(hall, (1.1, 1.6)),
    "storeys": Repeating(storeys, (2.2, 3.2), rate_hz=2.0, other_m=2.8, right_m=0.2, sway_m=0.2),
    "terminal": Repeating(terminal, (4.0, 7.0)),
    "solar": Repeating(solar, (3.0, 5.0), clearance_m=0.8, right_m=0.2, sway_m=0.15),
    "bridge": Repeating(bridge, (12.0, 18.0), right_m=1.75),
    "slabs": Repeating(slabs, (6.0, 9.0), right_m=0.2, sway_m=0.2),
}
"""Sceneries by the names that `simulate_repeating` accepts. Append new ones: benchmarks draw seeds by their order."""
