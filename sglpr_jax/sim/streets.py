"""Network of streets around a drive: the driven streets, each once, and side streets; and the ground along them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import binary_dilation, gaussian_filter1d
from scipy.spatial import KDTree

from sglpr_jax.se3 import lengths_along
from sglpr_jax.sim.ground import CELL_M, Ground, Relief
from sglpr_jax.sim.labels import LANE_MARKING, OTHER_GROUND, ROAD, TERRAIN
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.styles import STYLES, TOWN, Scenery, Side, draw_side

MIDDLE_M = 1.2  # distance from the first pass to the middle of the street on its left, in metres
SAME_STREET_M = 7.0  # maximum distance between two passes along the same street, in metres
HIGHWAY_MPS = 17.0  # speed above which a street is a highway, in m/s
ROUNDABOUT_M = (5.5, 16.0)  # minimum and maximum radius of the path around a roundabout, in metres

_SAME_PASS_M = 30  # distance along the path within which points belong to the same pass, in metres
_SIDE_STREET_M = (30.0, 60.0)  # range of the length of a side street, in metres
_STRETCH_M = (40.0, 150.0)  # range of the length of a stretch, in metres
_LOOK_ALIKE_M = (300.0, 600.0)  # the same for a stretch of equal houses
REACH_M = 40.0  # maximum distance of painted ground from a street, in metres; farther ground is terrain
GARDEN_M = 30.0  # depth of the gardens behind the sidewalk, in metres
BLOCK_CELLS = 2  # width of a block, whose cells all use the same nearest point of a street
_CHUNK = 500_000  # approximate number of blocks that are painted together
_MAX_STRIPS = 5  # maximum number of strips on one side of a street


class Stretch(NamedTuple):
    """Part of a street with one style on each side, from `start` to `stop` metres along the street."""

    start: int
    stop: int
    half_width: float  # half width of the carriageway, metres
    sides: tuple[Side, Side]  # left and right


class Street(NamedTuple):
    """Middle line of a street with one point per metre, and the stretches of one width and style that divide it."""

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


def path_of(trajectory: Line, times: Float[np.ndarray, " n"]) -> Path:
    """Resamples `trajectory` to one point per metre. A standstill becomes one point.

    Raises:
      ValueError: The trajectory is shorter than 2 m or not finite, or `times` do not increase.
    """
    if len(trajectory) < 2 or not (np.isfinite(trajectory).all() and np.all(np.diff(times) > 0)):
        raise ValueError("a trajectory needs two or more finite points at increasing times")
    length_m = lengths_along(trajectory)
    moved = np.concatenate([[True], np.diff(length_m) > 1e-6])
    if length_m[-1] < 2:
        raise ValueError(f"a trajectory needs a length of 2 m or more, found {length_m[-1]:.2f} m")
    even_m = np.linspace(0, length_m[-1], int(length_m[-1]) + 1)
    xy = np.stack([np.interp(even_m, length_m[moved], axis) for axis in trajectory[moved].T], axis=1)
    seconds = np.interp(even_m, length_m[moved], times[moved])
    direction = np.gradient(gaussian_filter1d(xy, 2.0, axis=0, mode="nearest"), axis=0)
    seconds_per_point = gaussian_filter1d(np.gradient(seconds), 10.0, mode="nearest")
    heading = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
    return Path(xy, heading, seconds, np.gradient(even_m) / np.maximum(seconds_per_point, 1e-3))


def revisits(path: Path) -> Bool[np.ndarray, " n"]:
    """Whether each point of the path is on a street that was driven before, in either direction."""
    pairs = KDTree(path.xy).query_pairs(SAME_STREET_M, output_type="ndarray")
    is_parallel = np.abs(np.cos(path.heading[pairs[:, 0]] - path.heading[pairs[:, 1]])) > 0.75
    pairs = pairs[is_parallel & (pairs[:, 1] - pairs[:, 0] > _SAME_PASS_M)]
    is_revisit = np.zeros(len(path.xy), bool)
    # Sorted by the later point, so that `is_revisit` of the earlier point is final. Only first passes count.
    for earlier, later in pairs[np.lexsort(pairs.T)].tolist():
        is_revisit[later] |= not is_revisit[earlier]
    return is_revisit


def runs(mask: Bool[np.ndarray, " n"], gap: int) -> Iterator[tuple[int, int]]:
    """Yields the first index of each run of True in `mask`, and one past the last. Gaps below `gap` are closed."""
    indices = np.flatnonzero(mask)
    for run in np.split(indices, np.flatnonzero(np.diff(indices) > gap) + 1):
        if len(run):
            yield int(run[0]), int(run[-1]) + 1


def draw_streets(rng: np.random.Generator, path: Path, scenery: Scenery = TOWN) -> tuple[Street, ...]:
    """Draws the streets along `path` and their side streets."""
    middle = gaussian_filter1d(path.xy + MIDDLE_M * path.left, 1.5, axis=0, mode="nearest")
    style = _draw_style_name(rng, scenery)
    streets, lines = [], [middle]
    for first, last in runs(~revisits(path), gap=12):
        # A run begins and ends on an existing street and extends 4 m into it.
        points = slice(max(first - 4, 0), min(last + 4, len(middle)))
        is_fast = path.speed[points] > HIGHWAY_MPS
        street = Street(middle[points], path.heading[points], tuple(_draw_stretches(rng, is_fast, style, scenery)))
        streets.append(street)
        for start, heading in _branch_starts(rng, street, scenery):
            length, bend = rng.uniform(*_SIDE_STREET_M), rng.normal(0, 0.004)
            branch = _line_to_next_street(start, heading, length, bend, KDTree(np.concatenate(lines)))
            if len(branch) > 20:
                lines.append(branch)
                direction, is_fast = np.gradient(branch, axis=0), np.zeros(len(branch), bool)
                stretches = tuple(_draw_stretches(rng, is_fast, _draw_style_name(rng, scenery), scenery))
                streets.append(Street(branch, np.unwrap(np.arctan2(direction[:, 1], direction[:, 0])), stretches))
    return tuple(streets)


def _draw_style_name(rng: np.random.Generator, scenery: Scenery) -> str:
    frequencies = np.array(list(scenery.styles.values()))
    return str(rng.choice(list(scenery.styles), p=frequencies / frequencies.sum()))


def _draw_stretches(
    rng: np.random.Generator, is_fast: Bool[np.ndarray, " n"], style_name: str, scenery: Scenery
) -> Iterator[Stretch]:
    """Divides a street into stretches. Where the vehicle is fast (`is_fast`, one value per metre), it is a highway.

    The first stretches have the style `style_name`. Some stretches are long and consist of equal houses.
    """
    start, speed_changes = 0, np.flatnonzero(np.diff(is_fast.astype(int))) + 1
    extra_half_width = rng.uniform(-0.2, 0.2)
    while start < len(is_fast):
        look_alike = rng.random() < scenery.look_alike
        stop = min(start + int(rng.uniform(*(_LOOK_ALIKE_M if look_alike else _STRETCH_M))), len(is_fast))
        stop = min([stop, *speed_changes[speed_changes > start].tolist()])
        if rng.random() >= 0.7:
            style_name = _draw_style_name(rng, scenery)
        left_style = STYLES["highway" if is_fast[start] else style_name]
        half_width = sum(left_style.road) / 2 + extra_half_width
        has_median = rng.random() < left_style.median
        # One stretch in four has another style on its right side.
        right_style = left_style if is_fast[start] or rng.random() < 0.75 else STYLES[_draw_style_name(rng, scenery)]
        left = draw_side(rng, left_style, has_median=has_median, look_alike=look_alike)
        right = draw_side(rng, right_style, has_median=False, look_alike=look_alike)
        yield Stretch(start, stop, half_width, (left, right))
        start = stop


def _branch_starts(rng: np.random.Generator, street: Street, scenery: Scenery) -> list[tuple[np.ndarray, float]]:
    """Draws start points and headings of side streets: straight on at sharp bends, and sideways at random points."""
    starts = []  # index of the point, which is also metres along the street, and heading
    for turn in _sharp_turns(street.heading):
        before, after = max(turn - 10, 0), min(turn + 10, len(street.heading) - 1)
        if rng.random() < 0.8:
            starts.append((before, street.heading[before]))
        if rng.random() < 0.6:
            starts.append((after, street.heading[after] + np.pi))
    is_wide = np.concatenate([np.full(part.stop - part.start, part.half_width > 5) for part in street.stretches])
    position_m = rng.uniform(15, 60)
    while position_m < len(street.middle) - 15:
        point = int(position_m)
        if not is_wide[point]:  # no crossings on highways
            turn = rng.choice((-1, 1)) * np.pi / 2 + rng.normal(0, 0.15)
            starts.append((point, street.heading[point] + turn))
            if rng.random() < 0.5:  # a side street on the other side, too
                starts.append((point, starts[-1][1] + np.pi))
        position_m += rng.uniform(*scenery.crossing_every_m)
    return [(street.middle[point], float(heading)) for point, heading in starts]


def _sharp_turns(heading: Float[np.ndarray, " n"]) -> Iterator[int]:
    """Yields the index of the middle of each bend of 50 to 120 degrees within 20 m. Points are 1 m apart."""
    if len(heading) <= 60:
        return
    angle = np.abs(heading[20:] - heading[:-20])
    for first, last in runs(angle > np.radians(50), gap=5):
        sharpest = first + int(angle[first:last].argmax())
        if angle[sharpest] < np.radians(120):
            yield sharpest + 10


def _line_to_next_street(
    start: Float[np.ndarray, "2"], heading: float, length: float, curvature: float, streets: KDTree
) -> Line:
    """Curve from `start` to the next street that it meets within `length` metres, with a point every metre.

    A curve that meets no street ends before it comes near one. A curve that runs along a street is empty.
    """
    along_m = np.arange(int(length))
    bearing = heading + curvature * along_m
    line = start + np.cumsum(np.stack([np.cos(bearing), np.sin(bearing)], axis=1), axis=0)
    distance = streets.query(line)[0]
    meetings = np.flatnonzero((distance < 2) & (along_m > 15))
    near_street = (distance < 14) & (along_m > 16)
    if len(meetings):
        end = meetings[0] + 1
        return line[:end] if near_street[:end].sum() < 22 else line[:0]
    return line[: np.flatnonzero(near_street)[0]] if near_street.any() else line


def roundabouts(path: Path) -> tuple[Island, ...]:
    """Islands of the roundabouts on the path, which are left-hand bends of at least 150 degrees with a small radius."""
    curvature = gaussian_filter1d(np.gradient(path.heading), 2.0)
    on_small_circle = (curvature > 1 / ROUNDABOUT_M[1]) & (curvature < 1 / ROUNDABOUT_M[0])
    islands = []
    for first, last in runs(on_small_circle, gap=3):
        angle = path.heading[last - 1] - path.heading[first]
        if angle > np.radians(150):
            path_radius = (last - first) / angle
            centre = (path.xy[first:last] + path_radius * path.left[first:last]).mean(axis=0)
            island_radius = KDTree(path.xy).query(centre)[0] - 3.5  # leaves room for the vehicle
            if island_radius > 1:
                islands.append(Island(centre, float(island_radius)))
    return tuple(islands)


class Network:
    """Table of the points of all streets, one row per metre of street, with queries for the nearest point."""

    def __init__(self, streets: tuple[Street, ...]):
        self.streets = streets
        self.middle = np.concatenate([street.middle for street in streets])
        self.heading = np.concatenate([street.heading for street in streets])
        self.street = np.repeat(np.arange(len(streets)), [len(street.middle) for street in streets])  # index
        self.stretches = tuple(stretch for street in streets for stretch in street.stretches)
        lengths = [stretch.stop - stretch.start for stretch in self.stretches]
        self.stretch = np.repeat(np.arange(len(self.stretches)), lengths)  # index in `stretches`
        self.half_width = np.array([stretch.half_width for stretch in self.stretches])[self.stretch]
        verges = np.array([[side.verge for side in stretch.sides] for stretch in self.stretches])
        self.verge = verges[self.stretch]  # (n, 2): width of all strips on the left and on the right
        self._tree = KDTree(self.middle)

    def nearest(self, xy: Float[np.ndarray, "m 2"]) -> Int[np.ndarray, " m"]:
        """Index of the street point nearest to each position."""
        return np.asarray(self._tree.query(xy)[1])

    def offset(self, xy: Float[np.ndarray, "m 2"], index: Int[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Distance to the left of the street at point `index`, negative to the right. Dead ends are round."""
        from_point, cos, sin = xy - self.middle[index], np.cos(self.heading[index]), np.sin(self.heading[index])
        left = cos * from_point[:, 1] - sin * from_point[:, 0]
        forward = np.abs(cos * from_point[:, 0] + sin * from_point[:, 1])
        return np.copysign(np.hypot(left, np.maximum(forward - 1, 0)), left)  # beyond the last point, forward > 1 m


def paint_ground(network: Network, islands: tuple[Island, ...], relief: Relief, path: Line) -> Ground:
    """Paints the labels of the ground around the streets and islands. Ground within 1.5 m of `path` is road."""
    block_m = BLOCK_CELLS * CELL_M
    origin = np.floor(network.middle.min(axis=0) - REACH_M - 20)
    columns, rows = np.ceil((network.middle.max(axis=0) + REACH_M + 20 - origin) / block_m).astype(int).tolist()
    raster = np.full((BLOCK_CELLS * rows, BLOCK_CELLS * columns), TERRAIN, np.uint8)
    profiles = _profiles(network.stretches)
    blocks = _blocks_near_streets((network.middle - origin) / block_m, (columns, rows), int(REACH_M / block_m))
    for chunk in np.array_split(blocks, len(blocks) // _CHUNK + 1):
        nearest = network.nearest(origin + (chunk + 0.5) * block_m)
        for cell_in_block in np.ndindex(BLOCK_CELLS, BLOCK_CELLS):
            cells = BLOCK_CELLS * chunk + cell_in_block
            xy = origin + (cells + 0.5) * CELL_M
            raster[cells[:, 1], cells[:, 0]] = _labels_of_positions(network, profiles, xy, nearest)
    for island in islands:  # a ring of 1 m around terrain
        _paint_disc(raster, (island.centre - origin) / CELL_M, island.radius / CELL_M, OTHER_GROUND)
        _paint_disc(raster, (island.centre - origin) / CELL_M, (island.radius - 1) / CELL_M, TERRAIN)
    _paint_path(raster, (path - origin) / CELL_M)
    return Ground(raster, origin, relief)


def _blocks_near_streets(points: Float[np.ndarray, "n 2"], size: tuple[int, int], reach: int) -> Int[np.ndarray, "m 2"]:
    """Column and row of all blocks within about `reach` blocks of a point, in a raster of `size` blocks.

    The search is on a coarse raster, whose cells are `reach` / 4 blocks wide, because dilation by `reach` is slow.
    """
    coarse = max(reach // 4, 1)
    is_near = np.zeros([-(-axis // coarse) for axis in size], bool)
    is_near[tuple((points // coarse).astype(int).T)] = True
    is_near = binary_dilation(is_near, np.ones((3, 3)), iterations=4)
    is_near = is_near.repeat(coarse, axis=0).repeat(coarse, axis=1)
    return np.argwhere(is_near[: size[0], : size[1]])


def _labels_of_positions(
    network: Network, profiles: tuple[np.ndarray, np.ndarray], xy: Line, nearest: Int[np.ndarray, " m"]
) -> UInt8[np.ndarray, " m"]:
    """Ground label at each position, from its distance to point `nearest` of a street. `profiles`: see `_profiles`."""
    bounds, labels = profiles
    offset = network.offset(xy, nearest)
    profile = 2 * network.stretch[nearest] + (offset < 0)
    strip = np.zeros(len(xy), int)
    for k in range(bounds.shape[1]):
        strip += np.abs(offset) >= bounds[profile, k]
    # Wide streets have a dashed line in their middle: 4 m of line, 5 m of gap.
    is_dash = (np.abs(offset) < 0.15) & (nearest % 9 < 4) & (network.half_width[nearest] > 3.4)
    return np.where(is_dash, LANE_MARKING, labels[profile, strip]).astype(np.uint8)


def _profiles(stretches: tuple[Stretch, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the road and its strips, in metres from the middle, and labels: before, between and after the bounds.

    Rows 2i and 2i + 1 are the left and right side of stretch i. Unused bounds are inf.
    """
    bounds = np.full((2 * len(stretches), _MAX_STRIPS + 1), np.inf)
    labels = np.full((2 * len(stretches), _MAX_STRIPS + 2), TERRAIN)
    for i, stretch in enumerate(stretches):
        for row, side in enumerate(stretch.sides, 2 * i):
            widths = [stretch.half_width, *(strip.width for strip in side.strips), GARDEN_M]
            side_labels = [ROAD, *(strip.label for strip in side.strips), side.style.garden]
            bounds[row, : len(widths)] = np.cumsum(widths)
            labels[row, : len(side_labels)] = side_labels
    return bounds, labels


def _paint_disc(raster: UInt8[np.ndarray, "r c"], centre: Float[np.ndarray, "2"], radius: float, label: int) -> None:
    """Paints a disc. `centre` (x, y) and `radius` are in units of cells."""
    first, last = np.floor(centre - radius).astype(int), np.ceil(centre + radius).astype(int)
    window = raster[first[1] : last[1], first[0] : last[0]]
    rows, columns = np.ogrid[first[1] : last[1], first[0] : last[0]]
    window[np.hypot(columns + 0.5 - centre[0], rows + 0.5 - centre[1]) < radius] = label


def _paint_path(raster: UInt8[np.ndarray, "r c"], path: Float[np.ndarray, "n 2"]) -> None:
    """Paints road under the vehicle, but keeps lane markings. `path` has one point per metre, in units of cells."""
    steps = np.arange(-6, 7)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    offsets = offsets[np.hypot(*offsets.T) < 6.5]  # disc around a point
    cells = np.unique((np.floor(path)[:, None] + offsets).astype(int).reshape(-1, 2), axis=0)
    cells = cells[raster[cells[:, 1], cells[:, 0]] != LANE_MARKING]
    raster[cells[:, 1], cells[:, 0]] = ROAD
