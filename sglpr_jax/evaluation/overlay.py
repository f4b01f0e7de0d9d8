"""Overlay of two images for display."""

import numpy as np
from jaxtyping import Float, Num
from scipy.ndimage import map_coordinates

from sglpr_jax.data.density_grid import RESOLUTION_M
from sglpr_jax.se3 import inverse


def overlaid(
    query: Num[np.ndarray, "n n"],
    match: Num[np.ndarray, "n n"],
    match_from_query: Float[np.ndarray, "4 4"],
    *,
    resolution_m: float = RESOLUTION_M,
) -> Float[np.ndarray, "n n 3"]:
    """Overlay a query on its match, as RGB colours from 0 to 1.

    The match is red. The query, transformed to the frame of the match, is cyan. Cells occupied in both are white.
    """
    size = len(match)
    down, right = np.mgrid[:size, :size] - (size - 1) / 2
    query_from_match = inverse(match_from_query)
    x, y = right * resolution_m, -down * resolution_m
    at_x = query_from_match[0, 0] * x + query_from_match[0, 1] * y + query_from_match[0, 3]
    at_y = query_from_match[1, 0] * x + query_from_match[1, 1] * y + query_from_match[1, 3]
    cells = [-at_y / resolution_m + (size - 1) / 2, at_x / resolution_m + (size - 1) / 2]
    moved = map_coordinates(np.asarray(query, np.float64), cells, order=1, mode="grid-constant")
    return np.stack([_bright(match), _bright(moved), _bright(moved)], axis=-1)


def _bright(image: Num[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return np.sqrt(np.asarray(image, np.float64) / max(float(image.max()), 1e-9))
