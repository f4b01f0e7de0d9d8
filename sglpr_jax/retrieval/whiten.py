"""Weights fitted to a sensor of one's own: its scans' descriptors say how the last layer spreads them."""

from collections.abc import Callable, Iterable

import numpy as np

from sglpr_jax.data import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.models.config import WHITENING_POWER
from sglpr_jax.models.params import Params
from sglpr_jax.models.whitening import unwhitened, whitened
from sglpr_jax.retrieval.embed import embed


def whiten(
    params: Params,
    recordings: Iterable[Recording],
    *,
    power: float = WHITENING_POWER,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Params:
    """`params` with a last layer fitted to the descriptors of all scans, in place of one that is there.

    It needs neither labels nor poses. `power` says by which power of their spread principal components are divided: 1
    evens out all. `on_progress` is told how many scans of a recording are done. So few scans that they say nothing of
    some directions are told by a warning.
    """
    params = unwhitened(params)
    found = np.concatenate([embed(params, each, on_progress=on_progress).descriptors for each in recordings])
    n, d = found.shape
    if n <= d:
        warn(f"expected more scans than a descriptor has numbers, {d}, to whiten with; better ten times, found {n}")
    return whitened(params, found, power=power)
