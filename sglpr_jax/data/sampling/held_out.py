"""A part of the training recordings that nothing is learnt from: on it a training is judged before the test."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from sglpr_jax.data.sampling.config import TupleConfig, ValidationConfig
from sglpr_jax.revisits import close_pairs


@dataclasses.dataclass(frozen=True, eq=False)
class Split:
    """Frames of one recording, rising. Those in neither part lie too near to both."""

    training: Int[np.ndarray, "_"]
    validation: Int[np.ndarray, "_"]


def hold_out(positions: Float[np.ndarray, "n 3"], config: ValidationConfig, sampling: TupleConfig) -> Split:
    """Split a recording: a stretch of frames and all its revisits for validation, what lies far from them for training.

    Every validation frame lies within the positive distance of the stretch, every training frame beyond the negative
    distance of every validation frame (both horizontal), so that no house is seen from both parts. Of all stretches
    it is the first whose share of the recording's revisiting frames is nearest to its share of the frames.
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
    """Which frames have a positive in another visit."""
    pairs = close_pairs(places, closer_than_m=sampling.positive_m)
    revisits = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > sampling.revisit_gap]
    return np.isin(np.arange(len(places)), revisits)


def _within(places: Float[np.ndarray, "n 2"], some: Float[np.ndarray, "m 2"], metres: float) -> Bool[np.ndarray, "n"]:
    return KDTree(some).query(places)[0] <= metres
