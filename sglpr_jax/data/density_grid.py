"""Size and cells of KITTI's ready-made density images, and of images computed in the same format."""

from sglpr_jax.grid import Grid

RESOLUTION_M = 0.4
"""Edge of a pixel, in metres."""
MAX_COUNT = 10
"""Maximum count of a cell. It is stored as grey value 255."""
SIZE = 151
"""Number of rows and of columns. The outer 13 on each side are empty, because points beyond 25 m are cropped."""


def check_density_grid(grid: Grid) -> None:
    """Raise ValueError if a grid has other cells than density images, or more of them."""
    if grid.resolution_m != RESOLUTION_M or max(grid.height, grid.width) > SIZE:
        raise ValueError(
            f"density images have {SIZE} x {SIZE} cells of {RESOLUTION_M} m: expected a grid of at most this size with "
            f"the same cells, found {grid.height} x {grid.width} cells of {grid.resolution_m} m"
        )
