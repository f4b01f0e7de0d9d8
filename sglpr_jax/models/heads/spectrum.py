"""Pooling by the amplitudes of a map's Fourier transform along its sectors, which a rotation leaves as they are."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.models.layers import Linear

FLOOR = 1e-6
"""Added to squared amplitudes: the gradient of a root at zero is not finite."""


class Spectrum(nn.Module):
    """Fewer channels, the amplitudes of the lowest `frequencies` of each, a linear layer."""

    output: int
    channels: int = 256
    """Of what is transformed: linear combinations of all channels at all radii."""
    frequencies: int = 32

    @nn.compact
    def __call__(self, features: Float[Array, "b r s c"]) -> Float[Array, "b {self.output}"]:
        """The vector before its L2 normalisation; from the transform on float32. Frequency 0 is the mean."""
        b, radii, sectors, c = features.shape
        columns = features.swapaxes(1, 2).reshape(b, sectors, radii * c)
        columns = Linear(self.channels, kernel_init=nn.initializers.he_normal(), name="narrow")(columns)
        size = amplitudes(columns.astype(jnp.float32), self.frequencies)
        init = nn.initializers.variance_scaling(1.0, "fan_in", "normal")
        return Linear(self.output, use_bias=False, kernel_init=init, name="linear")(size.reshape(b, -1))


def amplitudes(columns: Float[Array, "b s c"], frequencies: int) -> Float[Array, "b {frequencies} c"]:
    """|DFT| over the sectors, unitary, of so many frequencies from 0: as two products, which a GPU and a CPU like."""
    sectors = columns.shape[1]
    angle = (2 * np.pi / sectors) * (np.outer(np.arange(frequencies), np.arange(sectors)) % sectors)
    waves = np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32) / np.float32(np.sqrt(sectors))
    real, imaginary = (jnp.einsum("bsc,fs->bfc", columns, wave) for wave in waves)
    return jnp.sqrt(real**2 + imaginary**2 + FLOOR)
