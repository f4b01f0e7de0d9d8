"""Raw label ids of SemanticKITTI, and their categories in the settings of figure 9 (docs/reference/labels.md)."""

from collections.abc import Iterable
from typing import Literal

Categories = Literal[0, 6, 15, 20, 25, 34]
"""Number of categories of each setting of figure 9. 0: no semantics."""

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
"""Names of the 34 raw ids. Ids 252 to 259 are the moving variants of other ids."""

_NOTHING = (0, 1)
_MOVING = range(252, 260)
_MOVABLE = (10, 11, 13, 15, 16, 18, 20, 30, 31, 32, *_MOVING)
_STILL = tuple(raw for raw in RAW_NAMES if raw not in (*_NOTHING, *_MOVING))
_SCENE = tuple(raw for raw in _STILL if raw not in _MOVABLE)


def _named(raw_ids: Iterable[int]) -> dict[str, tuple[int, ...]]:
    """A separate class for each of these ids."""
    return {RAW_NAMES[raw]: (raw,) for raw in raw_ids}


RAW_IDS: dict[int, dict[str, tuple[int, ...]]] = {
    # The six groups of similar attributes in SemanticKITTI's paper.
    6: {
        "unlabeled": _NOTHING,
        "ground": (40, 44, 48, 49, 60),
        "structure": (50, 51, 52),
        "vehicle": (10, 11, 13, 15, 16, 18, 20, 252, 256, 257, 258, 259),
        "nature": (70, 71, 72),
        "human": (30, 31, 32, 253, 254, 255),
        "object": (80, 81, 99),
    },
    # Everything that can move is unlabelled, whether it moves or not.
    15: {"unlabeled": (*_NOTHING, *_MOVABLE), **_named(_SCENE)},
    # The classes of RINet, which are the dataset's own `learning_map`. Moving and standing objects share a class.
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
    # All moving objects are one class.
    25: {"unlabeled": _NOTHING, **_named(_STILL), "moving": tuple(_MOVING)},
    34: _named(RAW_NAMES),
}
"""Classes of each setting, in order, with their raw ids. The first raw id gives a class its colour."""
