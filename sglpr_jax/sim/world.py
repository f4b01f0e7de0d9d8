"""`build_world` draws the town around a drive: streets, objects along them and traffic. `Levels` describes storeys."""

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.sim.frontage import Clock, bystanders, frontage
from sglpr_jax.sim.ground import Ground, draw_relief
from sglpr_jax.sim.objects import bush
from sglpr_jax.sim.placement import CLEARANCE_M, HEAD_ROOM_M, PlacedObjects, Spot, distances, place, to_scene
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.shapes import Scene
from sglpr_jax.sim.streets import Island, Network, draw_streets, paint_ground, path_of, roundabouts, runs
from sglpr_jax.sim.styles import TOWN, Scenery
from sglpr_jax.sim.traffic import traffic

VIEW_M = 110.0  # distance from the vehicle above which standing objects are omitted, in metres
_TOLERANCE_M = 0.3  # depth to which objects may overlap the strips of a street, in metres


@dataclasses.dataclass(frozen=True)
class Levels:
    """Equal storeys above one another, joined by ramps above one another that descend along x.

    The simulated world holds the storeys side by side: storey k is shifted by k * `pitch_m` along y and has a level
    copy of the ramp. A path changes to the next storey in the middle of the ramp, and scans show a level ramp. The true
    poses follow the ramp's slope.
    """

    rise_m: float  # height of a storey, metres
    pitch_m: float  # distance of two storeys along y in the simulated world, metres
    ramp_y_m: float  # minimum y of paths on the ramps, metres; paths with smaller y are on a storey
    top_m: float  # x of the top of the ramps, metres
    foot_m: float  # x of the foot of the ramps, above `top_m`, metres

    def along(self, path: Line) -> tuple[Line, Float[np.ndarray, " n"], Line]:
        """Maps true positions to the simulated world. The path begins on the lowest storey, with close points.

        Returns:
          Positions in the simulated world, and true height (metres) and true slope along x and y of the ground there.
        """
        on_ramp, on_upper_half = path[:, 1] > self.ramp_y_m, path[:, 0] < (self.top_m + self.foot_m) / 2
        storey = np.concatenate([[0], np.cumsum(np.diff(on_upper_half.astype(int)) * on_ramp[1:])])
        run = self.foot_m - self.top_m
        fraction = ((self.foot_m - path[:, 0]) / run).clip(0, 1)  # of the ramp that is behind the vehicle
        # The ramp's height is a smoothstep. On its upper half, `storey` already counts the whole rise.
        climbed = np.where(on_ramp, fraction**2 * (3 - 2 * fraction) - on_upper_half, 0)
        steepness = np.where(on_ramp, 6 * fraction * (1 - fraction), 0) * self.rise_m / run
        slope = np.stack([-steepness, np.zeros(len(path))], axis=1)
        xy = path + self.pitch_m * np.stack([np.zeros(len(path)), storey], axis=1)
        return xy, self.rise_m * (storey + climbed), slope


class World(NamedTuple):
    """All shapes of a simulated world, in its frame, and the ground."""

    scene: Scene
    ground: Ground
    levels: Levels | None = None  # storeys above one another, which the scene holds side by side


def build_world(
    seed: int | tuple[int, ...], trajectory: Line, times: Float[np.ndarray, " n"], *, scenery: Scenery = TOWN
) -> World:
    """Builds a town along a drive: x and y of the LiDAR in metres, 0.2 to 3 m apart, with times in seconds.

    The vehicle may stand still. Nothing is closer to the trajectory than 1.6 m.

    Raises:
      ValueError: The trajectory is shorter than 2 m or not finite, or `times` do not increase.
    """
    rng = np.random.default_rng(seed)
    path = path_of(trajectory, times)
    relief = draw_relief(rng, steepest=scenery.steepest, wavelength_m=scenery.wavelength_m)
    network, islands = Network(draw_streets(rng, path, scenery)), roundabouts(path)
    ground = paint_ground(network, islands, relief, path.xy)
    clock = (float(times[0]), float(times[-1]))
    standing = _furnish(rng, network, islands, ground, path.xy, clock)
    bushes = [Spot(bush(rng), *island.centre.tolist()) for island in islands]
    placed = place([*standing, *bushes, *traffic(rng, network, path)], ground)
    shapes = placed.shapes
    is_visible = np.any(shapes.velocity != 0, axis=1)
    for i in range(0, len(path.xy), 10):  # every 10 m
        is_near = np.sum((shapes.centre[:, :2] - path.xy[i]) ** 2, axis=1) < VIEW_M**2
        is_visible |= is_near & (shapes.since <= path.times[i] + 2) & (shapes.until > path.times[i] - 2)
    return World(to_scene(placed, is_visible), ground)


def _furnish(
    rng: np.random.Generator, network: Network, islands: tuple[Island, ...], ground: Ground, path: Line, clock: Clock
) -> list[Spot]:
    """Draws the objects along the streets of `network`, clear of the streets, of roundabouts and of `path`."""
    spots, makers, is_clear = [], bystanders(rng), _is_clear_of_other_streets(network)
    first_point = 0  # index in `network` of the street's first point; points are 1 m apart
    for street in network.streets:
        for stretch, k in itertools.product(street.stretches, (0, 1)):  # k: left, right
            side = 1 - 2 * k
            clear_points = is_clear[first_point + stretch.start : first_point + stretch.stop, k]
            for low, high in runs(clear_points, gap=1):
                if high - low <= 3:
                    continue
                start, stop = float(stretch.start + low), float(stretch.start + high)
                for spot in frontage(rng, stretch.sides[k], start, stop, clock, makers):
                    x = first_point + min(max(spot.x, 0), stretch.stop - 0.01)
                    spots.append(spot._replace(x=x, y=side * (stretch.half_width + spot.y), side=side))
        first_point += len(street.middle)
    point = np.array([spot.x for spot in spots]).astype(int)
    spots = _moved_to_world(network, point, spots)
    placed = place(spots, ground)
    street, zone = network.street[point], np.array([spot.zone for spot in spots])
    is_blocked = _is_on_street(network, placed, street[placed.owner], zone[placed.owner])
    path_points = np.concatenate([path, (path[1:] + path[:-1]) / 2])
    is_blocked |= distances(placed.shapes, path_points, reach_m=CLEARANCE_M) < CLEARANCE_M + 0.05
    for island in islands:
        distance = np.linalg.norm(placed.shapes.centre[:, :2] - island.centre, axis=1)
        is_blocked |= distance < island.radius + 2 + np.hypot(placed.shapes.half[:, 0], placed.shapes.half[:, 1])
    removed = set(placed.owner[is_blocked].tolist())
    return [spot for i, spot in enumerate(spots) if i not in removed]


def _is_clear_of_other_streets(network: Network) -> Bool[np.ndarray, "n 2"]:
    """Whether the plots left and right of each street point begin outside all other streets."""
    left = np.stack([-np.sin(network.heading), np.cos(network.heading)], axis=1)
    columns = []
    for column, sign in ((0, 1), (1, -1)):
        edge = network.middle + sign * (network.half_width + network.verge[:, column] + 0.5)[:, None] * left
        columns.append(_distance_outside(network, edge, with_strips=np.ones(len(edge), bool)) >= -0.1)
    return np.stack(columns, axis=1)


def _distance_outside(network: Network, xy: np.ndarray, with_strips: np.ndarray) -> np.ndarray:
    """Distance in metres from each position to the nearest road, negative on it. Strips count if `with_strips`."""
    nearest = network.nearest(xy)
    offset = network.offset(xy, nearest)
    verge = network.verge[nearest, (offset < 0).astype(int)]
    return np.abs(offset) - network.half_width[nearest] - verge * with_strips


def _moved_to_world(network: Network, point: np.ndarray, spots: list[Spot]) -> list[Spot]:
    """Converts spots from street coordinates to the world.

    Before, x is the length along all streets (`point` is its integer part), and y the distance to the left of a street.
    """
    x, y, turn, side = np.array([spot[1:5] for spot in spots], dtype=np.float64).reshape(-1, 4).T
    beyond_point, heading = x - point, network.heading[point]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    xy = network.middle[point] + beyond_point[:, None] * ahead + y[:, None] * left
    poses = np.column_stack([xy, heading + side * turn]).tolist()
    return [spot._replace(x=x, y=y, heading=turn) for spot, (x, y, turn) in zip(spots, poses, strict=True)]


def _is_on_street(
    network: Network, placed: PlacedObjects, street: np.ndarray, zone: np.ndarray
) -> Bool[np.ndarray, " n"]:
    """Whether each shape touches ground that is not allowed for its zone, less than HEAD_ROOM_M above it.

    That is any road, for "plot" also the strips along it, and for "bay" also any street except its own, `street`.
    """
    shapes, is_on_street = placed.shapes, np.zeros(len(zone), bool)
    cos, sin = np.cos(shapes.yaw), np.sin(shapes.yaw)
    for x_fraction in np.linspace(-1, 1, 7):  # a grid of 7 x 5 points on each shape
        for y_fraction in np.linspace(-1, 1, 5):
            x, y = x_fraction * shapes.half[:, 0], y_fraction * shapes.half[:, 1]
            xy = np.asarray(shapes.centre)[:, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
            is_on_street |= _distance_outside(network, xy, zone == "plot") < -_TOLERANCE_M
            is_on_street |= (zone == "bay") & (network.street[network.nearest(xy)] != street)
    return is_on_street & np.array([part.bottom < HEAD_ROOM_M for part in placed.parts], bool)
