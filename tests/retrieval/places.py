"""Places that indexes are filled with: descriptors as drawn, one each half second along a line."""

import numpy as np

from sglpr_jax import Index
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

WIDTH = 8


def draw(n: int, seed: int = 0) -> np.ndarray:
    """So many descriptors of unit length, a row each."""
    rows = np.random.default_rng(seed).normal(size=(n, WIDTH)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def add_places(index: Index, n: int) -> None:
    """Fill an index with so many places."""
    index.add(draw(n), times=np.arange(n) / 2, positions=np.arange(3.0 * n).reshape(n, 3))


def file_of(n: int, *, weights_hash: str = "abc", seed: int = 0) -> DescriptorFile:
    """The descriptor file of a recording of so many scans."""
    return DescriptorFile(
        sequence="00",
        ids=tuple(f"frame{i}" for i in range(n)),
        positions=None,
        times=np.arange(n) / 2,
        descriptors=draw(n, seed),
        pose_source=None,
        config={},
        weights_hash=weights_hash,
    )
