"""Coarse comparison of images, which tells at little cost which scans may show the place of a query.

It has half as many rotations as the search, cells twice as large and blurs twice as wide, and takes a sixth of the
time. It replaces the descriptors where these do not tell places apart, for instance among trunks.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

from sglpr_jax.loops.compared_image import DEFAULT, AnyArray, cells
from sglpr_jax.loops.config import VerificationConfig
from sglpr_jax.loops.correlations import correlations, quarters
from sglpr_jax.loops.spectra import lower_half


@functools.partial(jax.jit, static_argnames="config")
def coarse_correlations(
    query: Complex[AnyArray, "2 s t f"],
    matches: Complex[AnyArray, "k s f"],
    count: Int[AnyArray, ""] | int | None = None,
    *,
    config: VerificationConfig = DEFAULT,
) -> Float[Array, " k"]:
    """Highest correlation of a query with each of k matches at any pose, by the coarse comparison.

    Arguments:
      query: Result of `spectra.query_spectra`.
      matches: Result of `spectra.match_spectra`.
      count: Number of compared matches, by default all. The others get -1.
      config: Settings of the exact comparison.
    """
    turned = quarters(lower_half(jnp.asarray(query)[:, :, ::2].swapaxes(1, 2), config).swapaxes(1, 2))
    matches = lower_half(jnp.asarray(matches), config)
    reach = cells(config.max_shift_m, 2 * config.resolution_m * config.coarse)

    def compare(k: Int[Array, ""], found: Float[Array, " k"]) -> Float[Array, " k"]:
        return found.at[k].set(correlations(turned, matches[k], reach).max((0, 2)).max())

    return jax.lax.fori_loop(0, len(matches) if count is None else count, compare, jnp.full(len(matches), -1.0))
