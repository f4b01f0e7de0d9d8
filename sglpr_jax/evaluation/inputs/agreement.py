"""Check that compared methods have the same frames. Scores on different recordings cannot be compared."""

import numpy as np

from sglpr_jax.evaluation.inputs import Input
from sglpr_jax.evaluation.protocols.source import ScoredPairs
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

NEAR_M = 0.01
"""Largest difference of equal positions, in metres. Programs round the numbers in their files."""
NEAR_S = 0.001
"""Largest difference of equal times, in seconds."""


def check_agreement(first: Input, other: Input) -> None:
    """Raise ValueError if `other` has other frames, positions or times than `first`. The message names a frame."""
    if isinstance(first, DescriptorFile) and isinstance(other, DescriptorFile) and first.ids != other.ids:
        raise ValueError(f"expected the frames of the first file, {_ids(first, other)}, found {_ids(other, first)}")
    _check_rows("positions", first.positions, other.positions, NEAR_M)
    if not isinstance(first, ScoredPairs) and not isinstance(other, ScoredPairs):
        if (first.times is None) != (other.times is None):
            has, has_not = ("times", "none") if first.times is not None else ("none", "times")
            raise ValueError(
                f"expected times in both files or in neither, found {has} in the first and {has_not} in this one"
            )
        _check_rows("times", first.times, other.times, NEAR_S)


def _check_rows(what: str, first: np.ndarray | None, other: np.ndarray | None, near: float) -> None:
    if first is None or other is None:
        return
    if len(first) != len(other):
        raise ValueError(f"expected {len(first)} {what}, as in the first file, found {len(other)}")
    apart = np.abs(first - other).reshape(len(first), -1).max(axis=1)
    row = int(apart.argmax())
    if apart[row] > near:
        raise ValueError(
            f"expected the {what} of the first file, {first[row].tolist()} in row {row}, found {other[row].tolist()}"
        )


def _ids(file: DescriptorFile, beside: DescriptorFile) -> str:
    """Return the number of frames and the first id that differs."""
    pairs = zip(file.ids, [*beside.ids, *[None] * len(file)], strict=False)
    strange = next((name for name, other in pairs if name != other), "none more")
    return f"{len(file)} with {strange!r}"
