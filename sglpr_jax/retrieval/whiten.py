"""Fits the whitening layer of a model to the scans of another sensor."""

from collections.abc import Callable, Iterable

import numpy as np

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.models.config import WHITENING_POWER
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import unwhitened, whitened
from sglpr_jax.retrieval.embed import embed


def whiten(
    params: Params,
    recordings: Iterable[Recording],
    *,
    power: float = WHITENING_POWER,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Params:
    """Return the weights with a whitening layer fitted to the descriptors of all scans. It replaces an existing layer.

    Labels and poses are not needed. If there are not more scans than numbers in a descriptor, a warning is issued.

    Arguments:
      params: Weights of the model.
      recordings: Recordings of the sensor.
      power: Principal components are divided by their spread to this power. With 1, all have equal spread.
      on_progress: Called with the number of finished scans of a recording.
    """
    params = unwhitened(params)
    found = np.concatenate([embed(params, each, on_progress=on_progress).descriptors for each in recordings])
    n, d = found.shape
    if n <= d:
        warn(
            f"expected more than {d} scans for whitening (the length of a descriptor), better ten times that, found {n}"
        )
    return whitened(params, found, power=power)
