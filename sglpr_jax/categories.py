"""SemanticKITTI's raw label ids, and figure 9's ways to sort them into categories (docs/reference/labels.md)."""

from collections.abc import Iterable
from typing import Literal

Categories = Literal[0, 6, 15, 20, 25, 34]
"""The settings of figure 9 by their number; 0 means no semantics at all."""

RAW_NAMES = {
    0: "unlabeled",
    1: "outlier",
    10: "car",
    11: "bicycle",
    13: "bus",
    15: "motorcycle",
    16: "on-rails",
    18: "truck",
    20: "other-vehicle",
    30: "person",
    31: "bicyclist",
    32: "motorcyclist",
    40: "road",
    44: "parking",
    48: "sidewalk",
    49: "other-ground",
    50: "building",
    51: "fence",
    52: "other-structure",
    60: "lane-marking",
    70: "vegetation",
    71: "trunk",
    72: "terrain",
    80: "pole",
    81: "traffic-sign",
    99: "other-object",
    252: "moving-car",
    253: "moving-bicyclist",
    254: "moving-person",
    255: "moving-motorcyclist",
    256: "moving-on-rails",
    257: "moving-bus",
    258: "moving-truck",
    259: "moving-other-vehicle",
}
"""The 34 raw ids. 252 to 259 are the moving twins of things that also stand still."""

_NOTHING = (0, 1)
_MOVING = range(252, 260)
_MOVABLE = (10, 11, 13, 15, 16, 18, 20, 30, 31, 32, *_MOVING)
_STILL = tuple(raw for raw in RAW_NAMES if raw not in (*_NOTHING, *_MOVING))
_SCENE = tuple(raw for raw in _STILL if raw not in _MOVABLE)


def _named(raw_ids: Iterable[int]) -> dict[str, tuple[int, ...]]:
    """A class of its own for each of these ids."""
    return {RAW_NAMES[raw]: (raw,) for raw in raw_ids}


RAW_IDS: dict[int, dict[str, tuple[int, ...]]] = {
    # Six groups of SemanticKITTI's paper: what has similar attributes.
    6: {
        "unlabeled": _NOTHING,
        "ground": (40, 44, 48, 49, 60),
        "structure": (50, 51, 52),
        "vehicle": (10, 11, 13, 15, 16, 18, 20, 252, 256, 257, 258, 259),
        "nature": (70, 71, 72),
        "human": (30, 31, 32, 253, 254, 255),
        "object": (80, 81, 99),
    },
    # All that can move, whether it does or not, is as if not annotated.
    15: {"unlabeled": (*_NOTHING, *_MOVABLE), **_named(_SCENE)},
    # RINet's, which is the dataset's own `learning_map`: a thing that moves is what it is when it stands.
    20: {
        "unlabeled": (0, 1, 52, 99),
        "car": (10, 252),
        "bicycle": (11,),
        "motorcycle": (15,),
        "truck": (18, 258),
        "other-vehicle": (20, 13, 16, 256, 257, 259),
        "person": (30, 254),
        "bicyclist": (31, 253),
        "motorcyclist": (32, 255),
        "road": (40, 60),
        "parking": (44,),
        "sidewalk": (48,),
        "other-ground": (49,),
        "building": (50,),
        "fence": (51,),
        "vegetation": (70,),
        "trunk": (71,),
        "terrain": (72,),
        "pole": (80,),
        "traffic-sign": (81,),
    },
    # All that moves is one thing.
    25: {"unlabeled": _NOTHING, **_named(_STILL), "moving": tuple(_MOVING)},
    34: _named(RAW_NAMES),
}
"""Of each setting its classes, in order, with the raw ids that become them; the first of these lends it its colour."""
