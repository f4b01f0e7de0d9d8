"""Network of streets around a drive: the driven streets, each once, and side streets; and the ground along them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import binary_dilation, gaussian_filter1d
from scipy.spatial import KDTree

from sglpr_jax.sim.ground import CELL_M, Ground, Relief
from sglpr_jax.sim.labels import LANE_MARKING, OTHER_GROUND, ROAD, TERRAIN
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.styles import STYLES, TOWN, Scenery, Side, draw_side

MIDDLE_M = 1.2  # distance from the first pass to the middle of the street on its left, in metres
SAME_STREET_M = 7.0  # maximum distance between two passes along the same street, in metres
HIGHWAY_MPS = 17.0
ROUNDABOUT_M = (5.5, 16.0)  # minimum and maximum radius of the path around a roundabout, in metres

_LOOK_BACK_M = 30  # distance along the path within which points belong to the same pass
_SIDE_STREET_M = (30.0, 60.0)
_STRETCH_M = (40.0, 150.0)
_LOOK_ALIKE_M = (300.0, 600.0)
REACH_M = 40.0  # maximum distance of painted ground from a street, in metres; farther ground is terrain
GARDEN_M = 30.0  # depth of the gardens behind the sidewalk, in metres
BLOCK_CELLS = 2  # width of a block, whose cells all use the same nearest point of a street
_CHUNK = 500_000
_STRIPS = 5  # maximum on one side


class Stretch(NamedTuple):
    """Part of a street with one style on each side, from `start` to `stop` metres along the street."""

    start: int
    stop: int
    half_width: float  # half width of the carriageway, metres
    sides: tuple[Side, Side]  # left and right


class Street(NamedTuple):
    """Line with one point per metre, and its stretches."""

    middle: np.ndarray  # (n, 2) metres
    heading: np.ndarray  # (n,) radians, unwrapped
    stretches: tuple[Stretch, ...]


class Path(NamedTuple):
    """Path of the vehicle with one point per metre."""

    xy: np.ndarray  # (n, 2) metres
    heading: np.ndarray  # (n,) radians, unwrapped
    times: np.ndarray  # (n,) seconds
    speed: np.ndarray  # (n,) metres per second, averaged over about 20 m

    @property
    def left(self) -> Float[np.ndarray, "n 2"]:
        """Unit vectors to the left of the path."""
        return np.stack([-np.sin(self.heading), np.cos(self.heading)], axis=1)


class Island(NamedTuple):
    """Central island of a roundabout."""

    centre: np.ndarray  # (2,) metres
    radius: float  # metres


def resample(trajectory: Line, times: Float[np.ndarray, " n"]) -> Path:
    """Resamples `trajectory` to one point per metre. A standstill becomes one point.

    Raises:
      ValueError: The trajectory is shorter than 2 m or not finite, or `times` do not increase.
    """
    if len(trajectory) < 2 or not (np.isfinite(trajectory).all() and np.all(np.diff(times) > 0)):
        raise ValueError("a trajectory needs two or more finite points at increasing times")
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(trajectory, axis=0), axis=1))])
    moved = np.concatenate([[True], np.diff(travelled) > 1e-6])
    if travelled[-1] < 2:
        raise ValueError(f"a trajectory needs a length of 2 m or more, found {travelled[-1]:.2f} m")
    at = np.linspace(0, travelled[-1], int(travelled[-1]) + 1)
    xy = np.stack([np.interp(at, travelled[moved], axis) for axis in trajectory[moved].T], axis=1)
    seconds = np.interp(at, travelled[moved], times[moved])
    ahead = np.gradient(gaussian_filter1d(xy, 2.0, axis=0, mode="nearest"), axis=0)
    pace = gaussian_filter1d(np.gradient(seconds), 10.0, mode="nearest")
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return Path(xy, heading, seconds, np.gradient(at) / np.maximum(pace, 1e-3))


def revisits(path: Path) -> Bool[np.ndarray, " n"]:
    """Whether each point of the path is on a street that was driven before, in either direction."""
    pairs = KDTree(path.xy).query_pairs(SAME_STREET_M, output_type="ndarray")
    parallel = np.abs(np.cos(path.heading[pairs[:, 0]] - path.heading[pairs[:, 1]])) > 0.75
    pairs = pairs[parallel & (pairs[:, 1] - pairs[:, 0] > _LOOK_BACK_M)]
    is_revisit = np.zeros(len(path.xy), bool)
    # Sorted by the later point, so that a pass is compared only with first passes.
    for older, later in pairs[np.lexsort(pairs.T)].tolist():
        is_revisit[later] |= not is_revisit[older]
    return is_revisit


def runs(keep: Bool[np.ndarray, " n"], gap: int) -> Iterator[tuple[int, int]]:
    """Yields the first index of each run of True, and one past the last. Gaps shorter than `gap` are closed."""
    indices = np.flatnonzero(keep)
    for run in np.split(indices, np.flatnonzero(np.diff(indices) > gap) + 1):
        if len(run):
            yield int(run[0]), int(run[-1]) + 1


def draw_streets(rng: np.random.Generator, path: Path, scenery: Scenery = TOWN) -> tuple[Street, ...]:
    """Draws the streets along `path` and their side streets."""
    middle = gaussian_filter1d(path.xy + MIDDLE_M * path.left, 1.5, axis=0, mode="nearest")
    style = _new_style(rng, scenery)
    streets, lines = [], [middle]
    for first, last in runs(~revisits(path), gap=12):
        # A run begins and ends on an existing street and extends 4 m into it.
        line = slice(max(first - 4, 0), min(last + 4, len(middle)))
        fast = path.speed[line] > HIGHWAY_MPS
        street = Street(middle[line], path.heading[line], tuple(_draw_stretches(rng, fast, style, scenery)))
        streets.append(street)
        for start, heading in _branch_starts(rng, street, scenery):
            length, bend = rng.uniform(*_SIDE_STREET_M), rng.normal(0, 0.004)
            branch = _free_line(start, heading, length, bend, KDTree(np.concatenate(lines)))
            if len(branch) > 20:
                lines.append(branch)
                ahead, slow = np.gradient(branch, axis=0), np.zeros(len(branch), bool)
                stretches = tuple(_draw_stretches(rng, slow, _new_style(rng, scenery), scenery))
                streets.append(Street(branch, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])), stretches))
    return tuple(streets)


def _new_style(rng: np.random.Generator, scenery: Scenery) -> str:
    shares = np.array(list(scenery.styles.values()))
    return str(rng.choice(list(scenery.styles), p=shares / shares.sum()))


def _draw_stretches(
    rng: np.random.Generator, fast: Bool[np.ndarray, " n"], name: str, scenery: Scenery
) -> Iterator[Stretch]:
    """Divides a street into stretches. A style lasts for several stretches. Some stretches are long and uniform."""
    start, changes = 0, np.flatnonzero(np.diff(fast.astype(int))) + 1
    town_width = rng.uniform(-0.2, 0.2)
    while start < len(fast):
        look_alike = rng.random() < scenery.look_alike
        stop = min(start + int(rng.uniform(*(_LOOK_ALIKE_M if look_alike else _STRETCH_M))), len(fast))
        stop = min([stop, *changes[changes > start].tolist()])
        name = name if rng.random() < 0.7 else _new_style(rng, scenery)
        left_style = STYLES["highway" if fast[start] else name]
        half_width = sum(left_style.road) / 2 + town_width
        median = rng.random() < left_style.median
        # One stretch in four has another style on its right side.
        right_style = left_style if fast[start] or rng.random() < 0.75 else STYLES[_new_style(rng, scenery)]
        left = draw_side(rng, left_style, median=median, look_alike=look_alike)
        right = draw_side(rng, right_style, median=False, look_alike=look_alike)
        yield Stretch(start, stop, half_width, (left, right))
        start = stop


def _branch_starts(rng: np.random.Generator, street: Street, scenery: Scenery) -> list[tuple[np.ndarray, float]]:
    """Start points and headings of possible side streets: ahead at sharp bends, and sideways at random points."""
    starts = []
    for turn in _sharp_turns(street.heading):
        before, after = max(turn - 10, 0), min(turn + 10, len(street.heading) - 1)
        starts += [(before, street.heading[before])] * (rng.random() < 0.8)
        starts += [(after, street.heading[after] + np.pi)] * (rng.random() < 0.6)
    highway = np.concatenate([np.full(part.stop - part.start, part.half_width > 5) for part in street.stretches])
    at = rng.uniform(15, 60)
    while at < len(street.middle) - 15:
        if not highway[int(at)]:
            turn = rng.choice((-1, 1)) * np.pi / 2 + rng.normal(0, 0.15)
            starts.append((int(at), street.heading[int(at)] + turn))
            if rng.random() < 0.5:
                starts.append((int(at), starts[-1][1] + np.pi))
        at += rng.uniform(*scenery.crossing_every_m)
    return [(street.middle[index], float(heading)) for index, heading in starts]


def _sharp_turns(heading: Float[np.ndarray, " n"]) -> Iterator[int]:
    """Yields the middle of each bend of 50 to 120 degrees within 20 m."""
    if len(heading) <= 60:
        return
    turned = np.abs(heading[20:] - heading[:-20])
    for first, last in runs(turned > np.radians(50), gap=5):
        peak = first + int(turned[first:last].argmax())
        if turned[peak] < np.radians(120):
            yield peak + 10


def _free_line(start: Float[np.ndarray, "2"], heading: float, length: float, bend: float, others: KDTree) -> Line:
    """Gentle curve from `start` to the next street that it meets. Where it runs along a street, it is cut or empty."""
    along = np.arange(int(length))
    bearing = heading + bend * along
    line = start + np.cumsum(np.stack([np.cos(bearing), np.sin(bearing)], axis=1), axis=0)
    distance = others.query(line)[0]
    met = np.flatnonzero((distance < 2) & (along > 15))
    line, distance = line[: met[0] + 1] if len(met) else line, distance[: met[0] + 1] if len(met) else distance
    beside = (distance < 14) & (along[: len(line)] > 16)
    if len(met):
        return line if beside.sum() < 22 else line[:0]
    return line[: np.flatnonzero(beside)[0]] if beside.any() else line


def roundabouts(path: Path) -> tuple[Island, ...]:
    """Islands of the roundabouts on the path, which are left-hand bends of at least 150 degrees with a small radius."""
    turning = gaussian_filter1d(np.gradient(path.heading), 2.0)
    round_it = (turning > 1 / ROUNDABOUT_M[1]) & (turning < 1 / ROUNDABOUT_M[0])
    islands = []
    for first, last in runs(round_it, gap=3):
        if path.heading[last - 1] - path.heading[first] > np.radians(150):
            radius = (last - first) / (path.heading[last - 1] - path.heading[first])
            centre = (path.xy[first:last] + radius * path.left[first:last]).mean(axis=0)
            free = KDTree(path.xy).query(centre)[0] - 3.5
            if free > 1:
                islands.append(Island(centre, float(free)))
    return tuple(islands)


class Network:
    """Table of the points of all streets, with queries for the nearest point."""

    def __init__(self, streets: tuple[Street, ...]):
        self.streets = streets
        self.middle = np.concatenate([street.middle for street in streets])
        self.heading = np.concatenate([street.heading for street in streets])
        self.street = np.repeat(np.arange(len(streets)), [len(street.middle) for street in streets])
        self.stretches = tuple(stretch for street in streets for stretch in street.stretches)
        self.stretch = np.repeat(np.arange(len(self.stretches)), [part.stop - part.start for part in self.stretches])
        self.half_width = np.array([part.half_width for part in self.stretches])[self.stretch]
        verges = np.array([[side.verge for side in part.sides] for part in self.stretches])
        self.verge = verges[self.stretch]  # (n, 2): left and right
        self._tree = KDTree(self.middle)

    def nearest(self, xy: Float[np.ndarray, "m 2"]) -> Int[np.ndarray, " m"]:
        """Index of the street point nearest to each position."""
        return np.asarray(self._tree.query(xy)[1])

    def offset(self, xy: Float[np.ndarray, "m 2"], index: Int[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Distance to the left of the street at point `index`, negative to the right. Dead ends are round."""
        away, cos, sin = xy - self.middle[index], np.cos(self.heading[index]), np.sin(self.heading[index])
        left, ahead = cos * away[:, 1] - sin * away[:, 0], np.abs(cos * away[:, 0] + sin * away[:, 1])
        return np.copysign(np.hypot(left, np.maximum(ahead - 1, 0)), left)


def paint_ground(network: Network, islands: tuple[Island, ...], relief: Relief, path: Line) -> Ground:
    """Paints the ground around the streets. Ground within 1.5 m of `path` is road."""
    block_m = BLOCK_CELLS * CELL_M
    low = np.floor(network.middle.min(axis=0) - REACH_M - 20)
    columns, rows = np.ceil((network.middle.max(axis=0) + REACH_M + 20 - low) / block_m).astype(int).tolist()
    label = np.full((BLOCK_CELLS * rows, BLOCK_CELLS * columns), TERRAIN, np.uint8)
    profiles = _profiles(network.stretches)
    blocks = _near_streets((network.middle - low) / block_m, (columns, rows), int(REACH_M / block_m))
    for chunk in np.array_split(blocks, len(blocks) // _CHUNK + 1):
        nearest = network.nearest(low + (chunk + 0.5) * block_m)
        for corner in np.ndindex(BLOCK_CELLS, BLOCK_CELLS):
            cells = BLOCK_CELLS * chunk + corner
            label[cells[:, 1], cells[:, 0]] = _labels(network, profiles, low + (cells + 0.5) * CELL_M, nearest)
    for island in islands:
        _paint_disc(label, (island.centre - low) / CELL_M, island.radius / CELL_M, OTHER_GROUND)
        _paint_disc(label, (island.centre - low) / CELL_M, (island.radius - 1) / CELL_M, TERRAIN)
    _paint_path(label, (path - low) / CELL_M)
    return Ground(label, low, relief)


def _near_streets(points: Float[np.ndarray, "n 2"], size: tuple[int, int], reach: int) -> Int[np.ndarray, "m 2"]:
    """Column and row of all blocks within about `reach` blocks of a point."""
    coarse = max(reach // 4, 1)
    near = np.zeros([-(-axis // coarse) for axis in size], bool)
    near[tuple((points // coarse).astype(int).T)] = True
    near = binary_dilation(near, np.ones((3, 3)), iterations=4)
    near = near.repeat(coarse, axis=0).repeat(coarse, axis=1)
    return np.argwhere(near[: size[0], : size[1]])


def _labels(
    network: Network, profiles: tuple[np.ndarray, np.ndarray], xy: Line, nearest: Int[np.ndarray, " m"]
) -> UInt8[np.ndarray, " m"]:
    """Label at each position, from the nearest point of a street."""
    bounds, names = profiles
    offset = network.offset(xy, nearest)
    profile = 2 * network.stretch[nearest] + (offset < 0)
    strip = np.zeros(len(xy), int)
    for k in range(bounds.shape[1]):
        strip += np.abs(offset) >= bounds[profile, k]
    label = names[profile, strip]
    dash = (np.abs(offset) < 0.15) & (nearest % 9 < 4) & (network.half_width[nearest] > 3.4)
    return np.where(dash, LANE_MARKING, label).astype(np.uint8)


def _profiles(stretches: tuple[Stretch, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the strips on both sides of each stretch, in metres from the middle, and the labels between them."""
    bounds = np.full((2 * len(stretches), _STRIPS + 1), np.inf)
    names = np.full((2 * len(stretches), _STRIPS + 2), TERRAIN)
    for i, stretch in enumerate(stretches):
        for row, side in enumerate(stretch.sides, 2 * i):
            widths = [stretch.half_width, *(strip.width for strip in side.strips), GARDEN_M]
            labels = [ROAD, *(strip.label for strip in side.strips), side.style.garden]
            bounds[row, : len(widths)] = np.cumsum(widths)
            names[row, : len(labels)] = labels
    return bounds, names


def _paint_disc(label: UInt8[np.ndarray, "r c"], centre: Float[np.ndarray, "2"], radius: float, name: int) -> None:
    first, last = np.floor(centre - radius).astype(int), np.ceil(centre + radius).astype(int)
    window = label[first[1] : last[1], first[0] : last[0]]
    rows, columns = np.ogrid[first[1] : last[1], first[0] : last[0]]
    window[np.hypot(columns + 0.5 - centre[0], rows + 0.5 - centre[1]) < radius] = name


def _paint_path(label: UInt8[np.ndarray, "r c"], path: Float[np.ndarray, "n 2"]) -> None:
    """Paints road under the vehicle, but keeps lane markings. `path` has one point per metre, in units of cells."""
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-6, 7)]), axis=-1).reshape(-1, 2)
    offsets = offsets[np.hypot(*offsets.T) < 6.5]
    cells = np.unique((np.floor(path)[:, None] + offsets).astype(int).reshape(-1, 2), axis=0)
    cells = cells[label[cells[:, 1], cells[:, 0]] != LANE_MARKING]
    label[cells[:, 1], cells[:, 0]] = ROAD
