"""SemanticKITTI's raw label ids and the 20 classes that SG-LPR and RINet learn (the dataset's `learning_map`)."""

import numpy as np
from jaxtyping import Int, Int32

CATEGORIES = (
    "unlabeled",
    "car",
    "bicycle",
    "motorcycle",
    "truck",
    "other-vehicle",
    "person",
    "bicyclist",
    "motorcyclist",
    "road",
    "parking",
    "sidewalk",
    "other-ground",
    "building",
    "fence",
    "vegetation",
    "trunk",
    "terrain",
    "pole",
    "traffic-sign",
)
"""The names of the classes, by class id. Class 0 stands for no label and is left out of scores."""

UNLABELLED = 0

COLORS = np.array(
    [
        (0, 0, 0),
        (100, 150, 245),
        (100, 230, 245),
        (30, 60, 150),
        (80, 30, 180),
        (0, 0, 255),
        (255, 30, 30),
        (255, 40, 200),
        (150, 30, 90),
        (255, 0, 255),
        (255, 150, 255),
        (75, 0, 75),
        (175, 0, 75),
        (255, 200, 0),
        (255, 120, 50),
        (0, 175, 0),
        (135, 60, 0),
        (150, 240, 80),
        (255, 240, 150),
        (255, 0, 0),
    ],
    dtype=np.uint8,
)
"""Red, green and blue (20, 3) of each class in pictures: SemanticKITTI's own colours."""

# class: the raw ids that become it; 252 to 259 are the moving twins of classes that also stand still
_RAW_IDS = {
    "unlabeled": (0, 1, 52, 99),
    "car": (10, 252),
    "bicycle": (11,),
    "motorcycle": (15,),
    "truck": (18, 258),
    "other-vehicle": (13, 16, 20, 256, 257, 259),
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
}

_CLASS_OF = np.full(260, -1, dtype=np.int32)
for _class_id, _category in enumerate(CATEGORIES):
    _CLASS_OF[list(_RAW_IDS[_category])] = _class_id


def to_classes(raw: Int[np.ndarray, "*shape"]) -> Int32[np.ndarray, "*shape"]:
    """Return the class id (0..19) of each raw SemanticKITTI id. Raises ValueError naming ids that do not exist."""
    classes = np.where((raw >= 0) & (raw < len(_CLASS_OF)), _CLASS_OF[np.clip(raw, 0, len(_CLASS_OF) - 1)], -1)
    if np.any(classes < 0):
        raise ValueError(f"expected raw SemanticKITTI ids, found {np.unique(raw[classes < 0])[:5].tolist()}")
    return classes
