"""Painting of the ground's labels by the distance to the nearest street."""

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import binary_dilation

from sglpr_jax.sim.ground import CELL_M, Ground, Relief
from sglpr_jax.sim.raw_ids import LANE_MARKING, OTHER_GROUND, ROAD, TERRAIN
from sglpr_jax.sim.streets import Island, Network, Stretch

REACH_M = 40.0
"""Maximum distance of painted ground from a street, in metres. Farther ground is terrain."""
GARDEN_M = 30.0
"""Depth of the gardens behind the sidewalk, in metres."""
BLOCK_CELLS = 2
"""Width of a block in cells. All cells of a block use the same nearest point of a street."""

_CHUNK = 500_000
_STRIPS = 5  # maximum on one side

Profiles = tuple[np.ndarray, np.ndarray]
"""Bounds (2 n, strips) and labels (2 n, strips + 1) across both sides of n stretches."""


def paint_ground(
    network: Network, islands: tuple[Island, ...], relief: Relief, path: Float[np.ndarray, "n 2"]
) -> Ground:
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
    _paint_way(label, (path - low) / CELL_M)
    return Ground(label, low, relief)


def _near_streets(points: Float[np.ndarray, "n 2"], size: tuple[int, int], reach: int) -> Int[np.ndarray, "m 2"]:
    """Column and row of all blocks within about `reach` blocks of a point."""
    coarse = max(reach // 4, 1)
    near = np.zeros([-(-axis // coarse) for axis in size], bool)
    near[tuple((points // coarse).astype(int).T)] = True
    near = binary_dilation(near, np.ones((3, 3)), iterations=4)
    corners = coarse * np.argwhere(near)
    inside = np.stack(np.meshgrid(np.arange(coarse), np.arange(coarse), indexing="ij"), axis=-1).reshape(-1, 2)
    blocks = (corners[:, None] + inside[None]).reshape(-1, 2)
    return blocks[np.all(blocks < size, axis=1)]


def _labels(
    network: Network, profiles: Profiles, xy: Float[np.ndarray, "m 2"], nearest: Int[np.ndarray, " m"]
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


def _profiles(stretches: tuple[Stretch, ...]) -> Profiles:
    """Bounds of the strips on both sides of each stretch, in metres from the middle, and the labels between them."""
    bounds = np.full((2 * len(stretches), _STRIPS + 1), np.inf)
    names = np.full((2 * len(stretches), _STRIPS + 2), TERRAIN)
    for i, stretch in enumerate(stretches):
        for row, side in ((2 * i, stretch.left), (2 * i + 1, stretch.right)):
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


def _paint_way(label: UInt8[np.ndarray, "r c"], path: Float[np.ndarray, "n 2"]) -> None:
    """Paints road under the vehicle, but keeps lane markings. `path` has one point per metre, in units of cells."""
    around = np.stack(np.meshgrid(*2 * [np.arange(-6, 7)]), axis=-1).reshape(-1, 2)
    around = around[np.hypot(*around.T) < 6.5]
    cells = np.unique((np.floor(path)[:, None] + around).astype(int).reshape(-1, 2), axis=0)
    cells = cells[label[cells[:, 1], cells[:, 0]] != LANE_MARKING]
    label[cells[:, 1], cells[:, 0]] = ROAD
