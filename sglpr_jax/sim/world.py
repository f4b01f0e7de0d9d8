"""Town around a drive: streets, things along them, and traffic, clear of the vehicle. Storeys above one another."""

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
from sglpr_jax.sim.streets import Island, Network, draw_streets, paint_ground, resample, roundabouts, runs
from sglpr_jax.sim.styles import TOWN, Scenery
from sglpr_jax.sim.traffic import traffic

VIEW_M = 110.0  # distance from the vehicle above which standing things are omitted, in metres
_TOLERANCE_M = 0.3  # depth to which things may overlap the strips of a street, in metres


@dataclasses.dataclass(frozen=True)
class Levels:
    """Equal storeys above one another, joined by ramps above one another that descend along x. All are in metres.

    In the world, storey k is shifted by k * `pitch_m` along y, with a level copy of the ramp. A path changes to the
    next storey in the middle of the ramp. Scans there show a level ramp. True poses follow the slope.
    """

    rise_m: float  # height of a storey
    pitch_m: float  # distance of two storeys along y in the world
    ramp_y_m: float  # minimum y of paths on the ramps; paths with smaller y are on a storey
    top_m: float  # x of the top of the ramps
    foot_m: float  # x of the foot of the ramps, above `top_m`

    def along(self, path: Line) -> tuple[Line, Float[np.ndarray, " n"], Line]:
        """Unfolds a path that begins on the lowest storey. Its points must be close to each other.

        Returns:
          Positions in the world, and true height (metres) and slope along x and y of the ground there.
        """
        on_ramp, is_beyond = path[:, 1] > self.ramp_y_m, path[:, 0] < (self.top_m + self.foot_m) / 2
        storey = np.concatenate([[0], np.cumsum(np.diff(is_beyond.astype(int)) * on_ramp[1:])])
        run = self.foot_m - self.top_m
        share = ((self.foot_m - path[:, 0]) / run).clip(0, 1)
        climbed = np.where(on_ramp, share**2 * (3 - 2 * share) - is_beyond, 0)
        steepness = np.where(on_ramp, 6 * share * (1 - share), 0) * self.rise_m / run
        slope = np.stack([-steepness, np.zeros(len(path))], axis=1)
        xy = path + self.pitch_m * np.stack([np.zeros(len(path)), storey], axis=1)
        return xy, self.rise_m * (storey + climbed), slope


class World(NamedTuple):
    """Town: all shapes in the world frame, and the ground."""

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
    path = resample(trajectory, times)
    relief = draw_relief(rng, scenery)
    network, islands = Network(draw_streets(rng, path, scenery)), roundabouts(path)
    ground = paint_ground(network, islands, relief, path.xy)
    clock = (float(times[0]), float(times[-1]))
    standing = _furnish(rng, network, islands, ground, path.xy, clock)
    bushes = [Spot(bush(rng), *island.centre.tolist()) for island in islands]
    placed = place([*standing, *bushes, *traffic(rng, network, path)], ground)
    shapes = placed.shapes
    keep = np.any(shapes.velocity != 0, axis=1)
    for i in range(0, len(path.xy), 10):
        near = np.sum((shapes.centre[:, :2] - path.xy[i]) ** 2, axis=1) < VIEW_M**2
        keep |= near & (shapes.since <= path.times[i] + 2) & (shapes.until > path.times[i] - 2)
    return World(to_scene(placed, keep), ground)


def _furnish(
    rng: np.random.Generator, network: Network, islands: tuple[Island, ...], ground: Ground, path: Line, clock: Clock
) -> list[Spot]:
    """Things along the streets of `network`, clear of the streets and of `path`."""
    spots, next_bystander, free, first = [], bystanders(rng), _free(network), 0
    for street in network.streets:
        for stretch, k in itertools.product(street.stretches, (0, 1)):
            for low, high in runs(free[first + stretch.start : first + stretch.stop, k], gap=1):
                bounds = float(stretch.start + low), float(stretch.start + high)
                for spot in frontage(rng, stretch.sides[k], *bounds, clock, next_bystander) if high - low > 3 else ():
                    along, side = first + min(max(spot.x, 0), stretch.stop - 0.01), 1 - 2 * k
                    spots.append(spot._replace(x=along, y=side * (stretch.half_width + spot.y), side=side))
        first += len(street.middle)
    point = np.array([spot.x for spot in spots]).astype(int)
    spots = _bent(network, point, spots)
    placed = place(spots, ground)
    street, zone = network.street[point], np.array([spot.zone for spot in spots])
    is_blocked = _on_a_street(network, placed, street[placed.owner], zone[placed.owner])
    path_points = np.concatenate([path, (path[1:] + path[:-1]) / 2])
    is_blocked |= distances(placed.shapes, path_points, reach_m=CLEARANCE_M) < CLEARANCE_M + 0.05
    for island in islands:
        distance = np.linalg.norm(placed.shapes.centre[:, :2] - island.centre, axis=1)
        is_blocked |= distance < island.radius + 2 + np.hypot(placed.shapes.half[:, 0], placed.shapes.half[:, 1])
    removed = set(placed.owner[is_blocked].tolist())
    return [spot for i, spot in enumerate(spots) if i not in removed]


def _free(network: Network) -> Bool[np.ndarray, "n 2"]:
    """Whether the edge of the plots beside each street point is clear of all other streets, left and right."""
    left = np.stack([-np.sin(network.heading), np.cos(network.heading)], axis=1)
    sides = []
    for column, sign in ((0, 1), (1, -1)):
        edge = network.middle + sign * (network.half_width + network.verge[:, column] + 0.5)[:, None] * left
        sides.append(_margin(network, edge, whole_street=np.ones(len(edge), bool)) >= -0.1)
    return np.stack(sides, axis=1)


def _margin(network: Network, xy: np.ndarray, whole_street: np.ndarray) -> np.ndarray:
    """Distance of each position outside the nearest road, or outside its strips where `whole_street` is true."""
    nearest = network.nearest(xy)
    offset = network.offset(xy, nearest)
    verge = network.verge[nearest, (offset < 0).astype(int)]
    return np.abs(offset) - network.half_width[nearest] - verge * whole_street


def _bent(network: Network, point: np.ndarray, spots: list[Spot]) -> list[Spot]:
    """Moves spots with x along all streets and y to the left of their middle to the world. `point` is the whole x."""
    x, y, turn, side = np.array([spot[1:5] for spot in spots], dtype=np.float64).reshape(-1, 4).T
    rest, heading = x - point, network.heading[point]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    xy = network.middle[point] + rest[:, None] * ahead + y[:, None] * left
    poses = np.column_stack([xy, heading + side * turn]).tolist()
    return [spot._replace(x=x, y=y, heading=turn) for spot, (x, y, turn) in zip(spots, poses, strict=True)]


def _on_a_street(
    network: Network, placed: PlacedObjects, street: np.ndarray, zone: np.ndarray
) -> Bool[np.ndarray, " n"]:
    """Whether each shape touches a road, or strips that it belongs behind. Cars must park on their own street."""
    shapes, is_on_street = placed.shapes, np.zeros(len(zone), bool)
    cos, sin = np.cos(shapes.yaw), np.sin(shapes.yaw)
    for u in np.linspace(-1, 1, 7):
        for v in np.linspace(-1, 1, 5):
            x, y = u * shapes.half[:, 0], v * shapes.half[:, 1]
            xy = np.asarray(shapes.centre)[:, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
            is_on_street |= _margin(network, xy, zone == "plot") < -_TOLERANCE_M
            is_on_street |= (zone == "bay") & (network.street[network.nearest(xy)] != street)
    return is_on_street & np.array([part.bottom < HEAD_ROOM_M for part in placed.parts], bool)
