"""Surroundings where places repeat, by name."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from sglpr_jax.sim.routes import Revisit
from sglpr_jax.sim.sceneries.bridge import bridge
from sglpr_jax.sim.sceneries.campus import campus
from sglpr_jax.sim.sceneries.car_park import car_park
from sglpr_jax.sim.sceneries.corridor import corridor
from sglpr_jax.sim.sceneries.field import field
from sglpr_jax.sim.sceneries.forest import forest
from sglpr_jax.sim.sceneries.garage import garage
from sglpr_jax.sim.sceneries.hall import hall
from sglpr_jax.sim.sceneries.highway import LANE_M, highway
from sglpr_jax.sim.sceneries.indoor import indoor
from sglpr_jax.sim.sceneries.orchard import orchard
from sglpr_jax.sim.sceneries.rooms import rooms, rooms_equal
from sglpr_jax.sim.sceneries.row_houses import row_houses
from sglpr_jax.sim.sceneries.site import Site
from sglpr_jax.sim.sceneries.slabs import slabs
from sglpr_jax.sim.sceneries.solar import solar
from sglpr_jax.sim.sceneries.storeys import storeys
from sglpr_jax.sim.sceneries.terminal import terminal
from sglpr_jax.sim.sceneries.tunnel import tunnel
from sglpr_jax.sim.sceneries.vineyard import vineyard
from sglpr_jax.sim.sceneries.walls import walls
from sglpr_jax.sim.sceneries.warehouse import warehouse
from sglpr_jax.sim.sceneries.yard import yard
from sglpr_jax.sim.things import Range


@dataclasses.dataclass(frozen=True)
class Repeating:
    """Surroundings where places repeat, and parameters of the drive through them."""

    site: Callable[[np.random.Generator, float, bool], Site]
    """Function of a random generator, the line's length in metres, and whether it is closed. It draws the scenery."""
    speed_mps: Range
    """Range of the speed, in m/s."""
    rate_hz: float = 4.0
    """Scans per second."""
    other_m: float = 20.0
    """Distance above which two frames show different places, in metres.

    Without revisits, all frames 30 s apart are farther apart than this.
    """
    clearance_m: float = 1.2
    """Minimum horizontal distance of standing things from the path, in metres."""
    right_m: float = 0.4
    """Distance of the path to the right of the middle of the road or aisle, in metres."""
    sway_m: float = 0.3
    """Maximum deviation from `right_m`, in metres. The deviation varies along the path."""
    height_m: float | None = None
    """Height of the sensor above the ground, in metres. None uses the height of the given sensor."""
    crosses: bool = False
    """Whether a drive with revisits in the opposite direction has a closed line, too, which crosses itself."""

    def is_closed(self, revisit: Revisit) -> bool:
        """Whether the line of a drive is closed."""
        return revisit == "same" or (self.crosses and revisit == "opposite")


_walked = functools.partial(
    Repeating, rate_hz=2.0, clearance_m=0.5, right_m=0.1, sway_m=0.2, height_m=1.5, crosses=True
)
_robot = functools.partial(Repeating, rate_hz=2.0, clearance_m=0.4, right_m=0.2, sway_m=0.15, height_m=0.5)
REPEATING = {
    "walls": Repeating(walls, (8.0, 12.0)),
    "highway": Repeating(highway, (15.0, 20.0), right_m=LANE_M / 2),
    "tunnel": Repeating(tunnel, (8.0, 14.0)),
    "car_park": Repeating(car_park, (4.0, 7.0)),
    "garage": Repeating(garage, (3.0, 5.0), other_m=9.0),
    "corridor": _robot(corridor, (0.5, 1.0), other_m=5.0),
    "rooms_equal": _robot(rooms_equal, (0.45, 0.7), other_m=4.0, right_m=0.0, sway_m=0.05),
    "rooms": _robot(rooms, (0.45, 0.7), other_m=4.0, right_m=0.0, sway_m=0.05),
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
"""Sceneries by the names that `simulate_repeating` accepts."""
