"""DiSCO (Xu et al., 2021): the spectrum of a polar map that a U-Net computes from the occupancy of a scan.

Published recipe: Adam 1e-5, constant; lazy quadruplet with margins 0.5 and 0.2 on squared L2, and cross entropy of the
yaw; positives within 1.5 m, negatives beyond 2 m, 20 epochs of NCLT. Differences: 2 tuples of 2 positives and 9 random
negatives a step, with the distances of the other methods. The head for the yaw is left out, because place recognition
does not use it.
"""

import functools

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Shaped, UInt8

from sglpr_jax.data.scan import Scan
from sglpr_jax.methods.cells import polar
from sglpr_jax.methods.learned.layers import Convolution, batch_norm, max_pool
from sglpr_jax.methods.learned.method import LearnedMethod, finite_points, quadruplet, roll_azimuths
from sglpr_jax.methods.recipe import Recipe, TupleConfig

RINGS, SECTORS, LAYERS = 40, 120, 20
NEAREST_M, FARTHEST_M = 1.0, 70.0
"""Horizontal distances from the sensor between which points count, in metres. A ring is 1.75 m wide."""
LOWEST_M, LAYER_M = -1.5, 0.5
"""Height of the lowest layer relative to the sensor, and height of a layer, in metres."""
FREQUENCIES = 32
"""Number of lowest frequencies that are kept along the rings and along the sectors."""


def occupancy(scan: Scan) -> UInt8[np.ndarray, "40 120 20"]:
    """Return 1 in the occupied cells of a polar grid: rings of 1.75 m, sectors of 3 degrees and layers of 0.5 m.

    Sectors are counter-clockwise from x. Points beyond 70 m are dropped; the published grid adds them to its last ring,
    up to a square. The layers begin 0.23 m above the ground of a sensor at 1.73 m. The published ones are 2 m high and
    begin 2 m above the zero of NCLT's vehicle. Raises ValueError if the scan shows no place (`check_cloud`).
    """
    radius, angle, z = polar(finite_points(scan))
    ring = radius * (RINGS / FARTHEST_M)
    sector = angle % (2 * np.pi) * (SECTORS / (2 * np.pi)) % SECTORS
    layer = np.floor((z - LOWEST_M) / LAYER_M)
    inside = (radius >= NEAREST_M) & (radius < FARTHEST_M) & (layer >= 0) & (layer < LAYERS)
    occupied_cells = tuple(index[inside].astype(np.int64) for index in (ring, sector, layer))
    grid = np.zeros((RINGS, SECTORS, LAYERS), np.uint8)
    grid[occupied_cells] = 1
    return grid


class DoubleConvolution(nn.Module):
    """Two 3 x 3 convolutions with batch normalisation. The sectors wrap around, and zeros surround the rings."""

    features: int
    last_activation: str = "relu"
    """Activation after the second convolution: "relu" or "sigmoid"."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"], *, train: bool) -> Float[Array, "b h w {self.features}"]:
        for activation in ("relu", self.last_activation):
            x = Convolution(self.features, circular=True, use_bias=True)(x)
            x = getattr(nn, activation)(batch_norm(train)(x))
        return x


class DiSCO(nn.Module):
    """U-Net on a polar occupancy grid, and the amplitudes of the 32 x 32 lowest frequencies of its map, from -16 to 15.

    The sectors wrap around in all layers; the published network pads them with zeros. A rotation by 24 degrees (8
    sectors) therefore does not change the descriptor. Other rotations change it a little, because of the pooling of 8
    neighbouring sectors.
    """

    @nn.compact
    def __call__(self, cells: Shaped[Array, "b 40 120 20"], *, train: bool = False) -> Float[Array, "b 1024"]:
        x = cells.astype(jnp.float32)
        skips = []
        for i, features in enumerate((64, 128, 256, 512, 256, 128, 64)):
            if i > 3:  # the decoder
                x = jnp.concatenate([skips.pop(), upsample(x)], axis=-1)
            last_activation = "sigmoid" if i == 6 else "relu"
            x = DoubleConvolution(features, last_activation, name=f"Block_{i}")(x, train=train)  # as in weight files
            if i < 3:  # the encoder
                skips.append(x)
                x = max_pool(x, size=2)
        amplitudes = jnp.abs(jnp.fft.fft2(nn.Dense(1)(x)[..., 0], norm="ortho"))
        from_lowest = jnp.roll(amplitudes, (FREQUENCIES // 2, FREQUENCIES // 2), axis=(1, 2))  # from frequency -16
        return from_lowest[:, :FREQUENCIES, :FREQUENCIES].reshape(len(cells), -1)


def upsample(x: Float[Array, "b h w c"]) -> Float[Array, "b 2*h 2*w c"]:
    """Double the rings (between the centres of the first and last) and the sectors (which wrap around) bilinearly."""
    rings = x.shape[1]
    source_ring = np.linspace(0, rings - 1, 2 * rings)
    ring_weights = np.maximum(0, 1 - np.abs(source_ring[:, None] - np.arange(rings))).astype(np.float32)
    x = jnp.einsum("ip,bpwc->biwc", ring_weights, x)
    left_half, right_half = (0.75 * x + 0.25 * jnp.roll(x, shift, axis=2) for shift in (1, -1))
    return jnp.stack([left_half, right_half], axis=3).reshape(*x.shape[:2], -1, x.shape[3])


DISCO = LearnedMethod(
    name="disco",
    source='Xu et al., "DiSCO", RA-L 2021, with circular padding',
    licence="MIT by the README, no licence file",
    takes="points",
    weights=7_798_337,
    network=DiSCO(),
    prepare=occupancy,
    rotate_inputs=roll_azimuths,
    loss=functools.partial(quadruplet, closest_positive=False),
    recipe=Recipe(TupleConfig(positives=2, negatives=9), tuples=2, learning_rates=(3e-6, 1e-5, 1e-4)),
)
