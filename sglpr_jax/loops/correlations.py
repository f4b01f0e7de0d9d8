"""Correlations of a query, at all rotations, with a match at all shifts up to a limit.

The correlation is needed at small shifts only, so the inverse Fourier transform is a product with small matrices, which
is faster than a full transform.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Float32

from sglpr_jax.loops.spectra import twice


class Halves(NamedTuple):
    """Real and imaginary parts of spectra: rows of frequencies 0 to s/2, and rows of frequencies -1, -2 and so on."""

    low: tuple[Float[Array, "h t f"], Float[Array, "h t f"]]
    high: tuple[Float[Array, "g t f"], Float[Array, "g t f"]]


def quarters(query: Complex[Array, "2 s t f"]) -> list[Halves]:
    """The result of `query_spectra` as `correlations` takes it. It is computed once for many matches."""
    return [_halves(quarter) for quarter in query]


def correlations(query: list[Halves], match: Complex[Array, "s f"], reach: int) -> Float[Array, "d _ d"]:
    """Correlation of a match with every rotated query at every shift: rows down, rotations, columns to the right.

    Arguments:
      query: Result of `quarters`.
      match: Spectrum of a match.
      reach: Maximum shift down and to the right, in cells.
    """
    first, second = (jnp.split(_quarter(half, match, reach), 2, axis=1) for half in query)
    return jnp.concatenate([first[0], second[0], first[1], second[1]], axis=1)


def _quarter(query: Halves, match: Complex[Array, "s f"], reach: int) -> Float[Array, "d _ d"]:
    """The same for t rotations, followed by these rotations plus 180 degrees.

    Even and odd parts are transformed separately, for shifts of zero and more. At the opposite shift the cosine is the
    same and the sine changes its sign. This takes a quarter of the multiplications of the full transform.
    """
    size, (_, turns, width) = len(match), query.low[0].shape
    cos_down, sin_down, cos_right, sin_right = map(jnp.asarray, _waves(reach, size))
    there = _halves(match[:, None])
    low, high = _products(there.low, query.low), _products(there.high, query.high)
    unpaired = ((1, len(low[0]) - len(high[0]) - 1), (0, 0), (0, 0))
    even = [one + jnp.pad(other, unpaired) for one, other in zip(low, high, strict=True)]
    odd = [one[1 : len(other) + 1] - other for one, other in zip(low, high, strict=True)]
    cos_real, cos_imaginary = (cos_down @ part.reshape(len(part), -1) for part in even)
    sin_real, sin_imaginary = (sin_down @ part.reshape(len(part), -1) for part in odd)
    real = _both_ways(cos_real, sin_imaginary, axis=0).reshape(-1, width)
    imaginary = _both_ways(cos_imaginary, -sin_real, axis=0).reshape(-1, width)
    found = _both_ways(real @ cos_right, imaginary @ sin_right, axis=1)
    return found.reshape(-1, 2 * turns, found.shape[1])


def _halves(spectra: Complex[Array, "s t f"]) -> Halves:
    size = len(spectra)
    low, high = spectra[: size // 2 + 1], spectra[::-1][: (size - 1) // 2]
    return Halves((low.real, low.imag), (high.real, high.imag))


def _products(
    match: tuple[Float[Array, "h 1 f"], Float[Array, "h 1 f"]],
    query: tuple[Float[Array, "h t f"], Float[Array, "h t f"]],
) -> tuple[Float[Array, "h 2*t f"], Float[Array, "h 2*t f"]]:
    """Real and imaginary parts of a match's spectrum times the complex conjugates of the query's spectra, and times
    these spectra themselves."""
    (a, b), (c, d) = match, query
    real = jnp.concatenate([a * c + b * d, a * c - b * d], axis=1)
    return real, jnp.concatenate([b * c - a * d, b * c + a * d], axis=1)


def _both_ways(even: Float[Array, "a b"], odd: Float[Array, "a b"], *, axis: int) -> Float[Array, "*c"]:
    """Values at all shifts in ascending order: even + odd at negative shifts, even - odd at the others."""
    before = jnp.flip(jax.lax.slice_in_dim(even + odd, 1, None, axis=axis), axis)
    return jnp.concatenate([before, even - odd], axis)


@functools.cache
def _waves(reach: int, size: int) -> tuple[Float32[np.ndarray, "_ _"], ...]:
    """Cosines and sines: shifts from 0 to reach by frequencies down, and frequencies by shifts to the right.

    The second pair is scaled for the inverse transform of a half spectrum. The sines down omit the frequencies that are
    their own opposites.
    """
    shifts, rows, columns = np.arange(reach + 1), np.arange(size // 2 + 1), np.arange(size // 2 + 1)
    down, right = (2 * np.pi / size * np.outer(*pair) for pair in ((shifts, rows), (columns, shifts)))
    often = twice(size).T / size**2
    sines = np.sin(down[:, 1 : (size - 1) // 2 + 1])
    found = np.cos(down), sines, np.cos(right) * often, np.sin(right) * often
    return tuple(values.astype(np.float32) for values in found)
