"""Reads point cloud maps of other tools in parts, so that a map may be larger than the memory."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sglpr_jax.data.formats.las import las_blocks
from sglpr_jax.data.formats.pcd import pcd_blocks
from sglpr_jax.data.formats.ply import ply_blocks

BLOCKS: dict[str, Callable[[Path], Iterator[Float64[np.ndarray, "_ 3"]]]] = {
    ".pcd": pcd_blocks,
    ".ply": ply_blocks,
    ".las": las_blocks,
    ".laz": las_blocks,
}
"""Readers by file ending."""


def is_cloud_file(path: Path) -> bool:
    """Whether the path is a file with the ending of a point cloud map."""
    return path.suffix.lower() in BLOCKS and path.is_file()


def cloud_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a map in parts, in metres. Raises the errors of the readers."""
    return BLOCKS[path.suffix.lower()](path)
