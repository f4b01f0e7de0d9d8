"""The page of label taxonomies: the class of every raw id in each setting of figure 9."""

import numpy as np
from fields import table

from sglpr_jax.categories import RAW_IDS, RAW_NAMES
from sglpr_jax.labels import taxonomy, to_classes

HEAD = """# Label taxonomies

Scan labels are SemanticKITTI's 34 raw ids. `model.categories` merges them into 6, 15, 20 (default), 25 or 34 categories
(figure 9 of the paper). With 0, the model has no segmentation head and reads no labels.

Class 0, `unlabeled`, contains cells without points or without a label. Scores exclude this class. With 25 and 6
categories, it is an additional class. Classes have SemanticKITTI's colours, except outlier, on-rails and the moving
classes. A merged category has the colour of its first raw id.
"""


def labels_page() -> str:
    """The raw ids, and their class in each setting."""
    rows = [(str(raw), name, *(_class(raw, categories) for categories in RAW_IDS)) for raw, name in RAW_NAMES.items()]
    return f"{HEAD}\n{table(('raw id', 'name', *map(str, RAW_IDS)), rows)}\n"


def _class(raw: int, categories: int) -> str:
    number = to_classes(np.array(raw), categories=categories).item()
    return f"{number} {taxonomy(categories).names[number]}"
