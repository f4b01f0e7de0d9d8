"""Plane of a bird's-eye-view image: its cells, and what they count."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import Positive, Size, check_fields

ImageKind = Literal["points", "density"]
"""Content of a cell: the number of points (equation 1), or of voxels as in the ready-made images of KITTI."""
DENSITY_RESOLUTION_M = 0.4
"""Edge of a pixel of a density image, in metres, as in KITTI's ready-made images."""
DENSITY_MAX_COUNT = 10
"""Maximum count of a cell of a density image. It is stored as grey value 255."""
DENSITY_SIZE = 151
"""Number of rows and of columns of a density image. The outer 13 on each side are empty, because points beyond 25 m are
dropped."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """Image plane of equation 1: cells of `resolution_m` metres. The sensor is where the four middle cells meet."""

    resolution_m: Positive = 0.2
    height: Size = 224
    width: Size = 224

    def __post_init__(self):
        check_fields(self)
        for name, size in (("height", self.height), ("width", self.width)):
            if size % 2:
                raise ValueError(f"{name}: expected an even number of cells, found {size}")


def check_density_grid(grid: Grid) -> None:
    """Raise ValueError if a grid cannot be cropped from a density image: other cells, or more than 151 on a side."""
    if grid.resolution_m != DENSITY_RESOLUTION_M or max(grid.height, grid.width) > DENSITY_SIZE:
        size = f"{DENSITY_SIZE} x {DENSITY_SIZE} cells of {DENSITY_RESOLUTION_M} m"
        raise ValueError(
            f"density images have {size}: expected a grid of at most this size with the same cells, found "
            f"{grid.height} x {grid.width} cells of {grid.resolution_m} m"
        )
