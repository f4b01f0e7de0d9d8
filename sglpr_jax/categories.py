"""Raw label ids of SemanticKITTI, and their categories in the settings of figure 9 (docs/reference/labels.md)."""

from collections.abc import Iterable
from typing import Literal

Categories = Literal[0, 6, 15, 20, 25, 34]
"""Number of categories of each setting of figure 9. 0: no semantics."""

_NOT_MOVING: dict[int, tuple[str, tuple[int, ...]]] = {
    0: ("unlabeled", (0, 0, 0)),
    1: ("outlier", (110, 110, 110)),
    10: ("car", (100, 150, 245)),
    11: ("bicycle", (100, 230, 245)),
    13: ("bus", (100, 80, 250)),
    15: ("motorcycle", (30, 60, 150)),
    16: ("on-rails", (0, 110, 170)),
    18: ("truck", (80, 30, 180)),
    20: ("other-vehicle", (0, 0, 255)),
    30: ("person", (255, 30, 30)),
    31: ("bicyclist", (255, 40, 200)),
    32: ("motorcyclist", (150, 30, 90)),
    40: ("road", (255, 0, 255)),
    44: ("parking", (255, 150, 255)),
    48: ("sidewalk", (75, 0, 75)),
    49: ("other-ground", (175, 0, 75)),
    50: ("building", (255, 200, 0)),
    51: ("fence", (255, 120, 50)),
    52: ("other-structure", (255, 150, 0)),
    60: ("lane-marking", (150, 255, 170)),
    70: ("vegetation", (0, 175, 0)),
    71: ("trunk", (135, 60, 0)),
    72: ("terrain", (150, 240, 80)),
    80: ("pole", (255, 240, 150)),
    81: ("traffic-sign", (255, 0, 0)),
    99: ("other-object", (50, 255, 255)),
}
"""Name and colour (red, green, blue) of the raw ids other than moving objects, as in SemanticKITTI. The colours of
outlier and on-rails differ."""
_MOVING = {252: 10, 253: 31, 254: 30, 255: 32, 256: 16, 257: 13, 258: 18, 259: 20}
"""Raw id of the standing object of the same type for each raw id of a moving object."""
RAW_NAMES = {raw: name for raw, (name, _) in _NOT_MOVING.items()}
RAW_NAMES |= {moving: f"moving-{RAW_NAMES[raw]}" for moving, raw in _MOVING.items()}
"""Names of the 34 raw ids."""
RAW_COLORS = {raw: color for raw, (_, color) in _NOT_MOVING.items()}
RAW_COLORS |= {moving: tuple((channel + 255) // 2 for channel in RAW_COLORS[raw]) for moving, raw in _MOVING.items()}
"""Red, green and blue of each raw id. Moving objects have the colour of the standing object, mixed half with white,
because SemanticKITTI draws them in the colours of other ids."""

_UNLABELED = (0, 1)
_MOVABLE = (10, 11, 13, 15, 16, 18, 20, 30, 31, 32, *_MOVING)
_STANDING = tuple(raw for raw in RAW_NAMES if raw not in (*_UNLABELED, *_MOVING))
_IMMOVABLE = tuple(raw for raw in _STANDING if raw not in _MOVABLE)


def _class_per_id(raw_ids: Iterable[int]) -> dict[str, tuple[int, ...]]:
    """A class for each raw id, with the name of the id."""
    return {RAW_NAMES[raw]: (raw,) for raw in raw_ids}


RAW_IDS: dict[int, dict[str, tuple[int, ...]]] = {
    # The six groups of similar attributes in SemanticKITTI's paper.
    6: {
        "unlabeled": _UNLABELED,
        "ground": (40, 44, 48, 49, 60),
        "structure": (50, 51, 52),
        "vehicle": (10, 11, 13, 15, 16, 18, 20, 252, 256, 257, 258, 259),
        "nature": (70, 71, 72),
        "human": (30, 31, 32, 253, 254, 255),
        "object": (80, 81, 99),
    },
    # Everything that can move is unlabelled, whether it moves or not.
    15: {"unlabeled": (*_UNLABELED, *_MOVABLE), **_class_per_id(_IMMOVABLE)},
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
    25: {"unlabeled": _UNLABELED, **_class_per_id(_STANDING), "moving": tuple(_MOVING)},
    34: _class_per_id(RAW_NAMES),
}
"""Classes of each setting, in order, with their raw ids. The first raw id gives a class its colour."""
