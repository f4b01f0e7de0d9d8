"""Retrieval after verification: the nearest places by descriptor, ordered by the correlation of their images."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import view
from sglpr_jax.evaluation.protocols.nearest import nearest_frames
from sglpr_jax.evaluation.protocols.source import TopK
from sglpr_jax.models.config import model_preset
from sglpr_jax.registration.bev_alignment import align_all
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.revisits import database_end

CANDIDATES = 5
"""Number of places that are verified for each query."""


def verified(file: DescriptorFile, images: Float32[np.ndarray, "n h w"]) -> TopK:
    """Return the nearest places of each frame, ordered by `align`.

    Arguments:
      file: Descriptors of a recording.
      images: Image of each frame.
    """
    ends = database_end(len(file), times=file.times)
    queries = np.flatnonzero(ends)
    nearest, _ = nearest_frames(file, queries, ends[queries], k=CANDIDATES)
    correlations = np.stack([_correlations(images, int(q), row) for q, row in zip(queries, nearest, strict=True)])
    order = np.argsort(-correlations, axis=1, kind="stable")
    assert file.positions is not None
    return TopK(
        sequence=file.sequence,
        positions=file.positions,
        times=file.times,
        pose_source=file.pose_source,
        queries=queries,
        nearest=np.take_along_axis(nearest, order, axis=1),
        scores=np.take_along_axis(correlations, order, axis=1),
    )


def _correlations(images: np.ndarray, query: int, nearest: np.ndarray) -> np.ndarray:
    """Return the correlation of a frame with each of its nearest places; -1 where there is no further place."""
    found = align_all(images[query], images[nearest])
    return np.where(nearest >= 0, np.asarray(found.correlation, np.float64), -1.0)


def images_of(recording: Recording, rows: Sequence[int]) -> Float32[np.ndarray, "n h w"]:
    """Return the density images of scans or images of a recording, in the window of `sglpr`."""
    grid = model_preset("sglpr").grid
    seen = (view(recording.record(row, labels=False), grid, image="density").image for row in rows)
    return np.stack([np.asarray(one, np.float32) for one in seen])
