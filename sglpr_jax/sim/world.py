"""A street grid: blocks of houses between straight streets, drawn from a seed."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.sim.frontage import PARKING, ROAD, SIDEWALK, STYLES, TERRAIN, Item, Style, Verge, draw_verge, frontage
from sglpr_jax.sim.shapes import Scene, Shapes

BLOCK_M = (46.0, 72.0)
"""Range of the distance between two neighbouring streets."""
ROAD_HALF_WIDTH_M = (3.0, 4.6)
KERB_M = 0.12
"""How high a block lies above the road."""
CELL_M = 0.25
"""Resolution of the ground's raster."""
GROUND = 0
"""Label of a shape that is ground: what it is called there depends on the place."""


class Ground(NamedTuple):
    """What the ground is called, as a raster over the world."""

    label: np.ndarray  # (rows, columns) uint8 raw SemanticKITTI ids; row = y, column = x, cells of CELL_M
    origin: np.ndarray  # (2,) x and y of the raster's first corner, metres

    def around(self, centre: Float[np.ndarray, "2"], reach_m: float) -> "Ground":
        """The square of half size `reach_m` around `centre`, of one size everywhere; the edge goes on outside."""
        cells = int(reach_m / CELL_M) + 1
        first = np.floor((centre - self.origin) / CELL_M).astype(int) - cells
        columns, rows = (first[:, None] + np.arange(2 * cells + 1)).clip(0, np.array(self.label.shape)[::-1, None] - 1)
        return Ground(self.label[np.ix_(rows, columns)], self.origin + first * CELL_M)


class World(NamedTuple):
    """A town of straight streets: scene and ground in the world frame (road surface at z = 0), and the street lines."""

    scene: Scene
    ground: Ground
    streets_x: np.ndarray  # x of the streets that run along y, metres, increasing
    streets_y: np.ndarray  # y of the streets that run along x


class Block(NamedTuple):
    """A rectangle between four kerbs and how it is built."""

    corner: Float[np.ndarray, "2"]
    size: Float[np.ndarray, "2"]
    style: Style
    verge: Verge

    def sides(self) -> Iterator[tuple[Float[np.ndarray, "2"], float, float]]:
        """Yield start corner, length and heading of the four sides, counter-clockwise: the block lies to the left."""
        x, y = self.size
        for corner, length, quarter in (((0, 0), x, 0), ((x, 0), y, 1), ((x, y), x, 2), ((0, y), y, 3)):
            yield self.corner + np.array(corner), length, quarter * np.pi / 2


def build_world(seed: int | tuple[int, ...], *, streets: tuple[int, int]) -> World:
    """Return the town of `seed` with `streets` streets along y and along x (at least two of each)."""
    rng = np.random.default_rng(seed)
    streets_x, streets_y = (np.cumsum(rng.uniform(*BLOCK_M, count)) for count in streets)
    half_x, half_y = (rng.uniform(*ROAD_HALF_WIDTH_M, count) for count in streets)
    blocks = []
    for i in range(streets[0] - 1):
        for j in range(streets[1] - 1):
            low = np.array([streets_x[i] + half_x[i], streets_y[j] + half_y[j]])
            high = np.array([streets_x[i + 1] - half_x[i + 1], streets_y[j + 1] - half_y[j + 1]])
            style = STYLES[rng.choice(list(STYLES), p=[0.25, 0.35, 0.15, 0.1, 0.15])]
            blocks.append(Block(low, high - low, style, draw_verge(rng, style)))
    return World(_scene(rng, blocks), _ground(blocks), streets_x, streets_y)


def _scene(rng: np.random.Generator, blocks: list[Block]) -> Scene:
    rows = {"box": [], "cylinder": [], "ellipsoid": []}
    for block in blocks:
        rows["box"].append([*(block.corner + block.size / 2), 0, *(block.size / 2), KERB_M, 0, GROUND, 0])
        for corner, length, heading in block.sides():
            for item in frontage(rng, block.style, block.verge, length):
                rows[item.kind].append(_row(item, corner, heading))
    return Scene(*(_shapes(rows[kind]) for kind in ("box", "cylinder", "ellipsoid")))


def _row(item: Item, corner: Float[np.ndarray, "2"], heading: float) -> list:
    """An item of a side in the world frame: centre, half sizes, yaw, label, roughness."""
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = corner[0] + cos * item.s - sin * item.d, corner[1] + sin * item.s + cos * item.d
    z = KERB_M + item.bottom + item.height / 2
    half = item.length / 2, item.width / 2, item.height / 2
    return [x, y, z, *half, heading + item.yaw, item.label, item.roughness]


def _shapes(rows: list[list]) -> Shapes:
    table = np.array(rows, dtype=np.float64).reshape(-1, 9)
    return Shapes(table[:, 0:3], table[:, 3:6], table[:, 6], table[:, 7].astype(np.int32), table[:, 8])


def _ground(blocks: list[Block]) -> Ground:
    """Paint the blocks' parking bays, sidewalks and gardens on a sheet of road."""
    low = np.min([block.corner for block in blocks], axis=0) - 10
    high = np.max([block.corner + block.size for block in blocks], axis=0) + 10
    columns, rows = np.ceil((high - low) / CELL_M).astype(int)
    label = np.full((rows, columns), ROAD, np.uint8)
    for block in blocks:
        verge = block.verge
        for inset, name in ((0, PARKING), (verge.bay, SIDEWALK), (verge.depth, block.style.garden)):
            first = np.round((block.corner + inset - low) / CELL_M).astype(int)
            last = np.round((block.corner + block.size - inset - low) / CELL_M).astype(int)
            label[first[1] : last[1], first[0] : last[0]] = name
    # Beyond the last street nothing is built: a field that the raster's edge continues.
    for edge in (np.s_[:20], np.s_[-20:], np.s_[:, :20], np.s_[:, -20:]):
        label[edge] = TERRAIN
    return Ground(label, low)
