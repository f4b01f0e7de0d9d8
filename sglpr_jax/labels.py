"""Conversion of label arrays between raw ids and the classes of figure 9's settings."""

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Int32, UInt8

from sglpr_jax.categories import RAW_COLORS, RAW_IDS, RAW_NAMES

UNLABELLED = 0
"""Class of unlabelled points in every setting. Scores exclude it."""


@dataclass(frozen=True, eq=False)
class Taxonomy:
    """Assignment of raw SemanticKITTI ids to classes 0 to k - 1. Class 0 is `UNLABELLED`."""

    names: tuple[str, ...]
    colors: UInt8[np.ndarray, "k 3"]
    """Red, green and blue of each class in pictures."""
    class_of: Int32[np.ndarray, " 260"]
    """Class of each raw id from 0 to 259, or -1 for ids that do not exist."""
    raw_of: Int32[np.ndarray, " k"]
    """First raw id of each class, which represents the class."""


@functools.cache
def taxonomy(categories: int = 20) -> Taxonomy:
    """Return the classes of one setting of figure 9. Raises ValueError for another number of categories."""
    if categories not in RAW_IDS:
        raise ValueError(f"categories: expected one of {', '.join(map(str, RAW_IDS))}, found {categories!r}")
    classes = RAW_IDS[categories]
    class_of = np.full(max(RAW_NAMES) + 1, -1, dtype=np.int32)
    for class_id, raw_ids in enumerate(classes.values()):
        class_of[list(raw_ids)] = class_id
    raw_of = np.array([raw_ids[0] for raw_ids in classes.values()], dtype=np.int32)
    colors = np.array([RAW_COLORS[raw] for raw in raw_of], np.uint8)
    return Taxonomy(names=tuple(classes), colors=colors, class_of=class_of, raw_of=raw_of)


CATEGORIES = taxonomy(20).names
"""Names of the 20 classes of SG-LPR and RINet, by class id."""


def to_classes(raw: Int[np.ndarray, "*shape"], *, categories: int = 20) -> Int32[np.ndarray, "*shape"]:
    """Return the class of each raw SemanticKITTI id. Raises ValueError with the ids that do not exist."""
    class_of = taxonomy(categories).class_of
    in_range = (raw >= 0) & (raw < len(class_of))
    classes = np.where(in_range, class_of[np.clip(raw, 0, len(class_of) - 1)], -1)
    if np.any(classes < 0):
        raise ValueError(f"expected raw SemanticKITTI ids, found {np.unique(raw[classes < 0])[:5].tolist()}")
    return classes


def to_raw(classes: Int[np.ndarray, "*shape"], *, categories: int = 20) -> Int32[np.ndarray, "*shape"]:
    """Return the first raw SemanticKITTI id of each class. `to_classes` with the same categories is the inverse."""
    return taxonomy(categories).raw_of[classes]
