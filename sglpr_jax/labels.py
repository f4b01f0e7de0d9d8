"""Conversion of label arrays between raw ids and the classes of figure 9's settings, and the colours of the classes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Int32, UInt8

from sglpr_jax.categories import RAW_IDS, RAW_NAMES

UNLABELLED = 0
"""Class of unlabelled points in every setting. Scores exclude it."""

# Red, green and blue of each raw id, as in SemanticKITTI. Only outlier, on-rails and moving objects have other colours,
# because SemanticKITTI draws them in the colours of other ids.
_COLORS: dict[int, tuple[int, ...]] = {
    0: (0, 0, 0),
    1: (110, 110, 110),
    10: (100, 150, 245),
    11: (100, 230, 245),
    13: (100, 80, 250),
    15: (30, 60, 150),
    16: (0, 110, 170),
    18: (80, 30, 180),
    20: (0, 0, 255),
    30: (255, 30, 30),
    31: (255, 40, 200),
    32: (150, 30, 90),
    40: (255, 0, 255),
    44: (255, 150, 255),
    48: (75, 0, 75),
    49: (175, 0, 75),
    50: (255, 200, 0),
    51: (255, 120, 50),
    52: (255, 150, 0),
    60: (150, 255, 170),
    70: (0, 175, 0),
    71: (135, 60, 0),
    72: (150, 240, 80),
    80: (255, 240, 150),
    81: (255, 0, 0),
    99: (50, 255, 255),
}
_STANDING_TWIN = {252: 10, 253: 31, 254: 30, 255: 32, 256: 16, 257: 13, 258: 18, 259: 20}


# A moving object has the colour of its standing variant, mixed half with white.
_COLORS |= {moving: tuple((channel + 255) // 2 for channel in _COLORS[raw]) for moving, raw in _STANDING_TWIN.items()}


@dataclass(frozen=True, eq=False)
class Taxonomy:
    """Assignment of raw ids to classes 0 to k - 1. Class 0 is `UNLABELLED`."""

    names: tuple[str, ...]
    colors: UInt8[np.ndarray, "k 3"]
    """Red, green and blue of each class in pictures."""
    class_of: Int32[np.ndarray, " 260"]
    """Class of each raw id, or -1 for ids that do not exist."""
    raw_of: Int32[np.ndarray, " k"]
    """Raw id that represents each class: the first id of the class."""


def _label_map(raw_ids: dict[str, tuple[int, ...]]) -> Taxonomy:
    class_of = np.full(max(RAW_NAMES) + 1, -1, dtype=np.int32)
    for class_id, members in enumerate(raw_ids.values()):
        class_of[list(members)] = class_id
    colors = np.array([_COLORS[members[0]] for members in raw_ids.values()], dtype=np.uint8)
    raw_of = np.array([members[0] for members in raw_ids.values()], dtype=np.int32)
    return Taxonomy(tuple(raw_ids), colors, class_of, raw_of)


_LABEL_MAPS = {categories: _label_map(raw_ids) for categories, raw_ids in RAW_IDS.items()}


def taxonomy(categories: int = 20) -> Taxonomy:
    """Return the classes of one setting of figure 9.

    Raises:
      ValueError: If there is no setting with this number of categories. The message lists the settings.
    """
    if categories not in _LABEL_MAPS:
        raise ValueError(f"categories: expected one of {', '.join(map(str, _LABEL_MAPS))}, found {categories!r}")
    return _LABEL_MAPS[categories]


CATEGORIES = taxonomy(20).names
"""Names of the 20 classes of SG-LPR and RINet, by class id."""


def to_classes(raw: Int[np.ndarray, "*shape"], *, categories: int = 20) -> Int32[np.ndarray, "*shape"]:
    """Return the class of each raw SemanticKITTI id. Raises ValueError with the ids that do not exist."""
    class_of = taxonomy(categories).class_of
    classes = np.where((raw >= 0) & (raw < len(class_of)), class_of[np.clip(raw, 0, len(class_of) - 1)], -1)
    if np.any(classes < 0):
        raise ValueError(f"expected raw SemanticKITTI ids, found {np.unique(raw[classes < 0])[:5].tolist()}")
    return classes


def to_raw(classes: Int[np.ndarray, "*shape"], *, categories: int = 20) -> Int32[np.ndarray, "*shape"]:
    """Return a raw SemanticKITTI id of each class. `to_classes` with the same categories is the inverse."""
    return taxonomy(categories).raw_of[classes]
