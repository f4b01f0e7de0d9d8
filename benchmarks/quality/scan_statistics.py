"""What the realism benchmark measures of one scan: numbers, and histograms that sum to 1."""

import itertools
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from sglpr_jax.bev import rasterize, rasterize_labels
from sglpr_jax.data.density_grid import RESOLUTION_M
from sglpr_jax.data.density_image import density_image, density_label_image
from sglpr_jax.labels import CATEGORIES
from sglpr_jax.models.config import model_preset

GRID = model_preset("sglpr").grid

Measures = Mapping[str, np.ndarray]

NUMBERS = {
    "points": "points of a scan",
    "occupied": "occupied cells of the preset `sglpr`'s grid, %",
    "image_occupied": "density image: pixels above 0, %",
    "image_value": "density image: mean of the pixels above 0 (of 255)",
}

_RANGES = (0, 3, 5, 7.5, 10, 15, 20, 30, 40, 60, 80)
_HEIGHTS = (-np.inf, -2.4, -2, -1.8, -1.6, -1.4, -1.2, -0.8, -0.4, 0, 0.5, 1, 1.5, 2, 3, np.inf)
_COUNTS = (1, 2, 3, 5, 9, 17, 33, 65, np.inf)
_DISTANCES = (0, 5, 7.5, 10, 12.5, 15, 17.5, 20, 25, 36)
_LATERALS = (0, *np.arange(1.8, 20, 2), 25.4)  # five rows of pixels each, but for the first and the last
_BINS = {
    "range": ("points by range, m", _RANGES),
    "height": ("points by height over the sensor, m", _HEIGHTS),
    "count": ("occupied cells by points in them", _COUNTS),
    "image_density": ("density image: pixels above 0 by value, tenths", np.arange(0.5, 11)),
    "image_distance": ("density image: pixels above 0 by distance, m", _DISTANCES),
    "image_lateral": ("density image: pixels above 0 by distance to the side, m", _LATERALS),
}


def _bin_names(edges: Sequence[float]) -> tuple[str, ...]:
    return tuple(f"{low:g} to {high:g}" for low, high in itertools.pairwise(edges))


HISTOGRAMS = {name: (title, _bin_names(edges)) for name, (title, edges) in _BINS.items()} | {
    "class_of_points": ("points by class", CATEGORIES),
    "class_of_cells": ("occupied cells by class", CATEGORIES),
    "class_of_pixels": ("density image's window: cells by class", CATEGORIES),
}
"""Title and names of the bins of every histogram. A bin holds its lower edge and not its upper one."""


def scan_measures(points: np.ndarray, classes: np.ndarray | None) -> Measures:
    """All measures of a scan (n, 3) in metres; those of classes only where it has them."""
    padding = (0, (1 << len(points).bit_length()) - len(points))  # few sizes, so few compilations
    padded, count = jnp.asarray(np.pad(points, (padding, (0, 0)))), jnp.asarray(len(points))
    counts = np.asarray(rasterize(padded, grid=GRID, count=count))
    measures = {
        "points": np.float64(len(points)),
        "occupied": 100 * np.mean(counts > 0),
        "range": _histogram("range", np.linalg.norm(points, axis=1)),
        "height": _histogram("height", points[:, 2]),
        "count": _histogram("count", counts[counts > 0]),
        **image_measures(np.rot90(density_image(points), -1)),
    }
    if classes is None:
        return measures
    cells = np.asarray(rasterize_labels(padded, jnp.asarray(np.pad(classes, padding)), grid=GRID, count=count))
    return measures | {
        "class_of_points": _share_of_classes(classes),
        "class_of_cells": _share_of_classes(cells[counts > 0]),
        "class_of_pixels": _share_of_classes(density_label_image(points, classes)),
    }


def image_measures(image: np.ndarray) -> Measures:
    """The measures of a density image (151, 151) of grey values, in the orientation of eq. 1."""
    half = image.shape[0] // 2
    down, right = np.nonzero(image)
    x, y = (right - half) * RESOLUTION_M, (half - down) * RESOLUTION_M
    values = image[down, right]
    return {
        "image_occupied": 100 * np.mean(image > 0),
        "image_value": np.mean(values) if len(values) else np.float64(0),
        "image_density": _histogram("image_density", values / 25.5),
        "image_distance": _histogram("image_distance", np.hypot(x, y)),
        "image_lateral": _histogram("image_lateral", np.abs(y)),
    }


def total_variation(a: np.ndarray, b: np.ndarray) -> float:
    """How much of one histogram must move to make the other, in percent."""
    return 50 * float(np.abs(a - b).sum())


def _histogram(name: str, values: np.ndarray) -> np.ndarray:
    _, edges = _BINS[name]
    counts = np.histogram(values, bins=edges)[0]
    return counts / max(counts.sum(), 1)


def _share_of_classes(classes: np.ndarray) -> np.ndarray:
    """The shares of the classes; class 0, which is no class, has none."""
    counts = np.bincount(classes.ravel(), minlength=len(CATEGORIES))
    counts[0] = 0
    return counts / max(counts.sum(), 1)
