"""File of a map of places: an index of descriptors with additional arrays."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.files import naming, replacing
from sglpr_jax.loops.given import given_poses
from sglpr_jax.poses import ROTATION_TOLERANCE
from sglpr_jax.retrieval.index import Index
from sglpr_jax.schema import Column, check_columns

ARRAYS = {
    "images": Column("uint8", ("n", "h", "h")),
    "world_from_place": Column("float64", ("n", 4, 4)),
    "mountings": Column("float64", ("n", 4)),
    "mounting_deviations": Column("float64", ("n", 2), finite=False, optional=True),
}
"""Arrays of a map's file in addition to the index."""
REQUIRED = tuple(name for name, column in ARRAYS.items() if not column.optional)


def write_places(path: Path, index: Index, arrays: Mapping[str, np.ndarray]) -> None:
    """Write index and arrays atomically to one file."""
    content = index.to_bytes(dict(arrays))
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_places(path: Path | str, *, weights_hash: str | None) -> tuple[Index, dict[str, np.ndarray]]:
    """Read index and arrays. Raises the errors of `Index.load`, and ValueError if the file has no valid map."""
    index, more = Index.load_with(path, weights_hash=weights_hash)
    left_out = [name for name in REQUIRED if name not in more]
    if left_out:
        raise ValueError(f"{path}: expected a map of places, found an index without {', '.join(left_out)}")
    with naming(path):
        _check(index, more)
    return index, {name: more[name] for name in ARRAYS if name in more}


def _check(index: Index, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if the content of a file is not that of a map."""
    if index.distance != "l2":
        raise ValueError(f"expected descriptors compared by l2, found {index.distance}")
    check_columns(arrays, ARRAYS, n=len(index))
    if arrays["images"].shape[1] % 2:
        raise ValueError(f"expected images of an even number of cells, found {arrays['images'].shape[1:]}")
    given_poses(arrays["world_from_place"], of="world_from_place")
    for height, *up in np.unique(arrays["mountings"], axis=0).tolist():
        Mounting(height, tuple(up))
        if abs(np.linalg.norm(up) - 1) > ROTATION_TOLERANCE:
            raise ValueError(f"expected up directions of length 1 in mountings, found {up}")
