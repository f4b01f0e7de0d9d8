"""Descriptors of places of the training recordings, computed in batches of one shape."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.sampling.batch import Batch, read_batch, views
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe
from sglpr_jax.training.config import TrainConfig

CHUNK = 16


def describe_places(
    params: Params,
    recordings: Sequence[Recording],
    pool: TuplePool,
    places: Int[np.ndarray, "n"],
    angles: Float[np.ndarray, "n"],
    config: TrainConfig,
) -> Float32[np.ndarray, "n d"]:
    """Describe places of the training recordings.

    Arguments:
      params: Weights of the model.
      recordings: Recordings of the pool.
      pool: Pool of the places.
      places: Frame numbers of the pool.
      angles: Rotation of each place about z, in radians.
      config: Settings of the run.

    Raises the errors of reading a scan.
    """
    described = []
    for start in range(0, len(places), CHUNK):
        rows = np.arange(start, start + CHUNK).clip(max=len(places) - 1)  # the last batch is padded with its last place
        batch = read_batch(
            recordings,
            pool,
            places[rows][:, None],
            max_points=config.max_points,
            share_negatives=True,
            categories=config.model.categories_read,
            image=config.model.image,
        )
        described.append(np.asarray(_describe(params, batch, jnp.asarray(angles[rows], jnp.float32))))
    return np.concatenate(described)[: len(places)].astype(np.float32)


@jax.jit
def _describe(params: Params, batch: Batch, angles: Float[Array, "b"]) -> Float[Array, "b d"]:
    return describe(params, *views(batch, angles, params.config.grid))
