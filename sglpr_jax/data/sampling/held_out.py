"""Holds out a part of the training recordings for validation."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from sglpr_jax.data.sampling.config import TupleConfig, ValidationConfig
from sglpr_jax.revisits import close_pairs


@dataclasses.dataclass(frozen=True, eq=False)
class Split:
    """Training and validation frames of one recording, in ascending order.

    Frames close to a validation frame are in neither.
    """

    training: Int[np.ndarray, "_"]
    validation: Int[np.ndarray, "_"]


def hold_out(positions: Float[np.ndarray, "n 3"], config: ValidationConfig, sampling: TupleConfig) -> Split:
    """Split a recording: a stretch of frames with all its revisits for validation, and distant frames for training.

    Every validation frame is within the positive distance of the stretch. Every training frame is beyond the negative
    distance of all validation frames, so that no house is visible in both parts. Both distances are horizontal. The
    stretch is the first one whose fraction of the revisiting frames is nearest to its fraction of all frames.
    """
    n = len(positions)
    length = round(config.share * n)
    if length == 0:
        return Split(np.arange(n), np.arange(0))
    places = positions[:, :2]
    revisiting = _revisiting(places, sampling)
    inside = np.convolve(revisiting, np.ones(length), mode="valid")
    start = int(np.abs(inside - config.share * revisiting.sum()).argmin())
    validation = _within(places, places[start : start + length], np.nextafter(sampling.positive_m, 0))
    near = _within(places, places[validation], sampling.negative_m)
    return Split(np.flatnonzero(~near), np.flatnonzero(validation))


def _revisiting(places: Float[np.ndarray, "n 2"], sampling: TupleConfig) -> Bool[np.ndarray, "n"]:
    """Mark the frames that have a positive in another visit."""
    pairs = close_pairs(places, closer_than_m=sampling.positive_m)
    revisits = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > sampling.revisit_gap]
    return np.isin(np.arange(len(places)), revisits)


def _within(places: Float[np.ndarray, "n 2"], some: Float[np.ndarray, "m 2"], metres: float) -> Bool[np.ndarray, "n"]:
    return KDTree(some).query(places)[0] <= metres
