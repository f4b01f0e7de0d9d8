"""Pooling by the amplitudes of a map's Fourier transform along its sectors, which a rotation does not change."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.models import initial
from sglpr_jax.models.layers import Linear

FLOOR = 1e-6
"""Added to squared amplitudes, because the gradient of a square root at zero is not finite."""


class Spectrum(nn.Module):
    """Reduction of the channels, amplitudes of the lowest `frequencies` of each channel, a linear layer."""

    output: int
    channels: int = 256
    """Number of transformed channels: linear combinations of all channels at all radii."""
    frequencies: int = 32

    @nn.compact
    def __call__(self, features: Float[Array, "b r s c"]) -> Float[Array, "b {self.output}"]:
        """Return the vector before its L2 normalisation.

        The transform and all later steps are float32. Frequency 0 is the mean.
        """
        b, radii, sectors, c = features.shape
        columns = features.swapaxes(1, 2).reshape(b, sectors, radii * c)
        columns = Linear(self.channels, kernel_init=initial.he_normal, name="narrow")(columns)
        size = amplitudes(columns.astype(jnp.float32), self.frequencies)
        unit = initial.scaled_normal(1.0)
        return Linear(self.output, use_bias=False, kernel_init=unit, name="linear")(size.reshape(b, -1))


def amplitudes(columns: Float[Array, "b s c"], frequencies: int) -> Float[Array, "b {frequencies} c"]:
    """Return the amplitudes of the unitary DFT over the sectors, for `frequencies` frequencies from 0.

    The transform is two matrix products, which are fast on GPU and CPU.
    """
    sectors = columns.shape[1]
    angle = (2 * np.pi / sectors) * (np.outer(np.arange(frequencies), np.arange(sectors)) % sectors)
    waves = np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32) / np.float32(np.sqrt(sectors))
    real, imaginary = (jnp.einsum("bsc,fs->bfc", columns, wave) for wave in waves)
    return jnp.sqrt(real**2 + imaginary**2 + FLOOR)
