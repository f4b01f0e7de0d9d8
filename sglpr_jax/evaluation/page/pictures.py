"""What a dataset and a model have to show, as plain arrays: the page knows nothing of where they come from."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, Num


@dataclass(frozen=True, eq=False)
class SemanticPicture:
    """One scan's semantic map."""

    counts: Num[np.ndarray, "h w"]
    """Points in each cell."""
    truth: Int[np.ndarray, "h w"] | None
    """Class ids, or None where the scan has no labels."""
    predicted: Int[np.ndarray, "h w"]
    """Class ids."""
    resolution_m: float
    categories: int = 20
    """Which classes the ids are (`labels.taxonomy`)."""


@dataclass(frozen=True, eq=False)
class HeatPicture:
    """How strongly the features of a network answer to one image."""

    image: Num[np.ndarray, "h w"]
    """Point counts."""
    maps: Mapping[str, Float[np.ndarray, "h w"]]
    """From 0 to 1, NaN where the network does not look, by the name of the layer."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """All pictures of a page, by frame; where there are none, a line says what they would need."""

    images: Mapping[int, Num[np.ndarray, "_ _"]] = field(default_factory=dict)
    """Point counts of the frames of false positives."""
    semantic: Mapping[str, SemanticPicture] | str = "Semantic maps: add --weights and --data."
    heat: Mapping[str, HeatPicture] | str = "Feature heat maps: add --weights and --data."
