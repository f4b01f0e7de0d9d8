"""What a dataset and a model have to show, as plain arrays: the page knows nothing of where they come from."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class SemanticPicture:
    """One scan's semantic map."""

    counts: np.ndarray
    """(h, w) integers: points in each cell."""
    truth: np.ndarray | None
    """(h, w) class ids, or None where the scan has no labels."""
    predicted: np.ndarray
    """(h, w) class ids."""
    resolution_m: float
    categories: int = 20
    """Which classes the ids are (`labels.label_map`)."""


@dataclass(frozen=True, eq=False)
class HeatPicture:
    """How strongly the features of a network answer to one image."""

    image: np.ndarray
    """(h, w) point counts."""
    maps: Mapping[str, np.ndarray]
    """(h, w) from 0 to 1, NaN where the network does not look, by the name of the layer."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """All of them, by frame; where there are none, a line says what they would need."""

    images: Mapping[int, np.ndarray] = field(default_factory=dict)
    """(h, w) point counts, of the frames of false positives."""
    semantic: Mapping[str, SemanticPicture] | str = "Semantic maps: add --weights and --data."
    heat: Mapping[str, HeatPicture] | str = "Feature heat maps: add --weights and --data."
