"""Positives and hard negatives of the training places, with and without worlds that recordings share."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

import sglpr_jax
from benchmarks.learned.data import TRAIN_IMAGES, folders, recordings_of
from benchmarks.table import Table
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.training.tuples import TuplePool, positions_of, worlds_of

FALSE_M = 5.0
"""Maximum distance of a false negative from its anchor, in metres."""
HARDEST = 10
"""Number of places with the most similar descriptors that count as the hardest negatives."""


def sampler(
    *,
    data: Path = Path("build/learned"),
    part: str = TRAIN_IMAGES,
    only: tuple[str, ...] = (),
    weights: str = DEFAULT_WEIGHTS,
    places: int = 200,
    seed: int = 0,
) -> None:
    """Count positives, and places near the anchor among its hardest negatives.

    Args:
        data: folder of the recordings of `learned data`.
        part: part of the recordings.
        only: datasets of the part, by name; all if omitted.
        weights: weights that describe the images.
        places: number of random anchors whose hardest negatives are looked at.
        seed: seed of the anchors.
    """
    chosen = [folder for folder in folders(data, part) if not only or folder.name in only]
    recordings = [one for folder in chosen for one in recordings_of(folder)]
    positions, worlds = [positions_of(recording) for recording in recordings], worlds_of(recordings)
    params = sglpr_jax.load(weights)
    descriptors = np.concatenate([sglpr_jax.embed(params, recording).descriptors for recording in recordings])
    true = TuplePool(positions, TupleConfig(), worlds=worlds)
    anchors = np.random.default_rng(seed).choice(len(true), min(places, len(true)), replace=False)
    table = Table("worlds", "recordings", "places", "positives", "in other recordings", "false negatives", "anchors")
    for name, shared in (("one a recording", None), ("shared", worlds)):
        pool = TuplePool(positions, TupleConfig(), worlds=shared)
        near = np.array([_false_negatives(pool, true, descriptors, anchor) for anchor in anchors.tolist()])
        of_anchors = np.repeat(pool.recording_of, np.diff(pool.revisits.starts))
        across = (of_anchors != pool.recording_of[pool.revisits.places]).sum()
        positives = len(pool.neighbours.places) + len(pool.revisits.places)
        shares = f"{near.mean() / HARDEST:.3f}", f"{(near > 0).mean():.3f}"
        table.add(name, len(recordings), len(pool), positives, across, *shares)


def _false_negatives(pool: TuplePool, true: TuplePool, descriptors: Float[np.ndarray, "n d"], anchor: int) -> int:
    """Return how many of the hardest negatives of an anchor are near it in truth."""
    candidates: Int[np.ndarray, " c"] = np.flatnonzero(pool.far_apart(np.array(anchor), np.arange(len(pool))))
    apart = np.linalg.norm(descriptors[candidates] - descriptors[anchor], axis=1)
    hardest = candidates[np.argsort(apart)[:HARDEST]]
    return int((true.distances_from_anchors(np.array([[anchor, *hardest]]))[0, 1:] < FALSE_M).sum())
