"""Whether methods that are compared speak of the same frames: a table of two recordings would compare nothing."""

import numpy as np

from sglpr_jax.evaluation.inputs import Input
from sglpr_jax.evaluation.protocols import ScoredPairs
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

NEAR_M = 0.01
"""Positions that differ by less are the same, written by another program."""
NEAR_S = 0.001


def check_agreement(first: Input, other: Input) -> None:
    """Raise ValueError, naming a frame, unless `other` has the frames, the positions and the times of `first`."""
    if isinstance(first, DescriptorFile) and isinstance(other, DescriptorFile) and first.ids != other.ids:
        raise ValueError(f"expected the frames of the first file, {_ids(first, other)}, found {_ids(other, first)}")
    _check_rows("positions", first.positions, other.positions, NEAR_M)
    if not isinstance(first, ScoredPairs) and not isinstance(other, ScoredPairs):
        if (first.times is None) != (other.times is None):
            has, has_not = ("times", "none") if first.times is not None else ("none", "times")
            raise ValueError(f"expected the times of the first file, {has}, found {has_not}")
        _check_rows("times", first.times, other.times, NEAR_S)


def _check_rows(what: str, first: np.ndarray | None, other: np.ndarray | None, near: float) -> None:
    if first is None or other is None:
        return
    if len(first) != len(other):
        raise ValueError(f"expected {len(first)} {what}, as the first file has, found {len(other)}")
    apart = np.abs(first - other).reshape(len(first), -1).max(axis=1)
    row = int(apart.argmax())
    if apart[row] > near:
        raise ValueError(
            f"expected the {what} of the first file, {first[row].tolist()} in row {row}, found {other[row].tolist()}"
        )


def _ids(file: DescriptorFile, beside: DescriptorFile) -> str:
    """How many there are, and the first that differs."""
    pairs = zip(file.ids, [*beside.ids, *[None] * len(file)], strict=False)
    strange = next((name for name, other in pairs if name != other), "none more")
    return f"{len(file)} with {strange!r}"
