"""Plane of a bird's-eye-view image: its cells, and what they count."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import Positive, Size, check_fields

ImageKind = Literal["points", "density"]
"""Content of a cell: the number of points (equation 1), or of voxels as in the ready-made images of KITTI."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """Image plane of equation 1: cells of `resolution_m` metres. The sensor is where the four middle cells meet."""

    resolution_m: Positive = 0.2
    height: Size = 224
    width: Size = 224

    def __post_init__(self):
        check_fields(self)
        for name, size in (("height", self.height), ("width", self.width)):
            if size % 2:
                raise ValueError(f"{name}: expected an even number of cells, found {size}")
