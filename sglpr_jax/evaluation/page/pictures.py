"""Images of a dataset and a model as plain arrays, independent of their source."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, Num


@dataclass(frozen=True, eq=False)
class SemanticPicture:
    """Semantic map of one scan."""

    counts: Num[np.ndarray, "h w"]
    """Number of points in each cell."""
    truth: Int[np.ndarray, "h w"] | None
    """True class ids, or None for a scan without labels."""
    predicted: Int[np.ndarray, "h w"]
    """Predicted class ids."""
    resolution_m: float
    """Side of a cell, in metres."""
    categories: int = 20
    """Number of categories in the taxonomy of the class ids (`labels.taxonomy`)."""


@dataclass(frozen=True, eq=False)
class HeatPicture:
    """Activation strength of the features of a network for one image."""

    image: Num[np.ndarray, "h w"]
    """Number of points in each cell."""
    maps: Mapping[str, Float[np.ndarray, "h w"]]
    """Activation from 0 to 1 by the name of the layer. NaN outside the field of view of the network."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Images of a page, by frame. A string instead of images says which options add them."""

    images: Mapping[int, Num[np.ndarray, "_ _"]] = field(default_factory=dict)
    """Point counts of the queries and answers of false positives, by frame number."""
    semantic: Mapping[str, SemanticPicture] | str = "Semantic maps: add --weights and --data."
    heat: Mapping[str, HeatPicture] | str = "Feature heat maps: add --weights and --data."
