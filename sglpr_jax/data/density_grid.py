"""The cells of the ready-made density images of KITTI, and so of those that are made like them."""

from sglpr_jax.grid import Grid

RESOLUTION_M = 0.4
"""The edge of a pixel in metres."""
MAX_COUNT = 10
"""The number of points at which the images were capped; it became 255."""
SIZE = 151
"""Rows and columns of an image. The crop leaves the outer 13 empty."""


def check_density_grid(grid: Grid) -> None:
    """Raises ValueError for a grid that cannot be cut out of density images."""
    if grid.resolution_m != RESOLUTION_M or max(grid.height, grid.width) > SIZE:
        raise ValueError(
            f"density images have {SIZE} x {SIZE} cells of {RESOLUTION_M} m: expected a grid of such cells, no larger, "
            f"found {grid.height} x {grid.width} cells of {grid.resolution_m} m"
        )
