"""BEVPlace++ (Luo et al., 2025) on density images, and its ablation ResNet-34 + NetVLAD, which rotates no images.

Published recipe: Adam 1e-4, constant; max over negatives of [0.3 + d_positive - d_negative]_+ with d = L2; 4 tuples of
1 positive and 10 hardest negatives, 40 epochs of KITTI 00; ResNet-34 from ImageNet, NetVLAD from k-means. Differences:
trained from scratch, half of the positives come from another visit, mining describes 256 random places every 25 steps,
and images are rotated by any angle. BEVPlace++ has 2 tuples a step, because a step of 24 images already needs 6 GB.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Float64, Num, UInt8

from sglpr_jax.bev import rotate_image
from sglpr_jax.data.scan import Scan, check_cloud
from sglpr_jax.data.views import check_ready_made, picture
from sglpr_jax.grid import DENSITY_MAX_COUNT, DENSITY_SIZE
from sglpr_jax.methods.learned.layers import (
    FEATURES,
    HE,
    LOCAL,
    Convolution,
    NetVLAD,
    batch_norm,
    fit_clusters,
    max_pool,
)
from sglpr_jax.methods.learned.method import LearnedMethod, triplet
from sglpr_jax.methods.recipe import Recipe, TupleConfig
from sglpr_jax.models.convolution import convolve
from sglpr_jax.models.input_image import Taps, resample
from sglpr_jax.models.layers import l2_normalize

GREY_SCALE = 256.0
"""Divisor of the grey values."""
ENCODER_STRIDE = 8
"""Pixels of the image per pixel of the encoder's result, along rows and columns."""
NETVLAD_STRIDE = 4
"""Pixels of the image per local feature of NetVLAD, to which the encoder's result is resampled."""
MARGIN = 0.3
CUBIC_A = -0.75
"""Parameter a of the cubic kernel. PyTorch uses -0.75, `jax.image.resize` -0.5."""


class ResidualBlock(nn.Module):
    """Residual block of two 3 x 3 convolutions. With a stride, the shortcut has a 1 x 1 convolution."""

    features: int
    stride: int = 1

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"], *, train: bool) -> Float[Array, "b _ _ {self.features}"]:
        strides = (self.stride, self.stride)
        y = batch_norm(train)(Convolution(self.features, strides=strides)(x))
        y = batch_norm(train)(Convolution(self.features)(nn.relu(y)))
        if self.stride > 1:
            x = batch_norm(train)(Convolution(self.features, size=1, strides=strides)(x))
        return nn.relu(x + y)


class Encoder(nn.Module):
    """ResNet-34 until the end of its second stage: 128 channels at an eighth of the resolution."""

    @nn.compact
    def __call__(self, images: Float[Array, "b h w"], *, train: bool) -> Float[Array, "b _ _ 128"]:
        """Encode grey images. The first kernel is summed over the three equal colours of the published network."""
        kernel = self.param("kernel", HE, (7, 7, 3, 64))
        x = convolve(images[..., None], kernel.sum(2, keepdims=True), (2, 2), False)  # not circular
        x = max_pool(nn.relu(batch_norm(train)(x)), size=3, border=1)
        blocks = [(64, 1)] * 3 + [(128, 2)] + [(128, 1)] * 3
        for i, (features, stride) in enumerate(blocks):
            x = ResidualBlock(features, stride, name=f"Block_{i}")(x, train=train)  # the name in weight files
        return x


class REIN(nn.Module):
    """Encode eight rotations of each image, take the maximum of the maps, and pool it by NetVLAD to unit length.

    The image is rotated by multiples of 45 degrees, and each map is rotated back. A rotation of the scan by 90 degrees
    only permutes the eight maps. The published network resamples every rotation and normalises each by its own
    statistics. Here rotations by 90 degrees are exact, and all eight share the statistics of the batch.
    """

    rotations: int = 8
    """Number of rotations: 8, or 1 for the ablation."""

    @nn.compact
    def __call__(self, images: Num[Array, "b h h"], *, train: bool = False) -> Float[Array, "b 8192"]:
        x = pad_to_odd_maps(images.astype(jnp.float32) / GREY_SCALE)
        encoder = Encoder()
        if self.rotations == 1:
            maps = encoder(x, train=train)
        else:
            rotated_maps = encoder(eight_rotations(x), train=train)
            maps = functools.reduce(jnp.maximum, rotate_maps_back(rotated_maps))
        features = l2_normalize(resize_maps(maps, images.shape[1] // NETVLAD_STRIDE))
        features = features.reshape(len(features), -1, features.shape[-1])
        self.sow(LOCAL, FEATURES, features)  # for `fit_clusters`
        return NetVLAD(64)(features)


def pad_to_odd_maps(images: Float[Array, "b h h"]) -> Float[Array, "b _ _"]:
    """Add zeros on all sides, so that all maps have a central pixel. Raises ValueError if the size is even."""
    size = images.shape[1]
    if size % 2 == 0:
        raise ValueError(f"expected images with an odd number of rows, found {size}")
    border = -(size - 1) % ENCODER_STRIDE // 2
    return jnp.pad(images, ((0, 0), (border, border), (border, border)))


def eight_rotations(images: Float[Array, "b h h"]) -> Float[Array, "8*b h h"]:
    """Return the images rotated by 0, 90, 180, 270, then 45, 135, 225 and 315 degrees."""
    taps = rotation_taps(images.shape[1], 45)
    diagonal_images = resample(images.reshape(len(images), -1, 1), taps).reshape(images.shape)
    return jnp.concatenate([jnp.rot90(x, k, (1, 2)) for x in (images, diagonal_images) for k in range(4)])


def rotate_maps_back(maps: Float[Array, "_ h h c"]) -> Float[Array, "8 b h h c"]:
    """Undo the rotations of `eight_rotations`, given the encoder's maps of the rotated images."""
    quarters_undone = [jnp.rot90(x, -(k % 4), (1, 2)) for k, x in enumerate(jnp.split(maps, 8))]
    diagonal_maps = resample_maps(jnp.concatenate(quarters_undone[4:]), rotation_taps(maps.shape[1], -45))
    return jnp.concatenate([*quarters_undone[:4], diagonal_maps]).reshape(8, -1, *maps.shape[1:])


@functools.cache
def rotation_taps(size: int, degrees: int) -> Taps:
    """Return the bicubic table of a counter-clockwise rotation of square images, with zeros outside of the image."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    y, x = (np.mgrid[:size, :size] - (size - 1) / 2).reshape(2, -1)
    source = np.stack([cos * y + sin * x, cos * x - sin * y]) + (size - 1) / 2  # row and column before the rotation
    neighbours = np.floor(source)[:, None] + np.arange(-1, 3)[:, None]  # axis (row, column), 4 neighbours, pixel
    is_inside = (neighbours >= 0) & (neighbours < size)
    row_weights, column_weights = cubic_weight(neighbours - source[:, None]) * is_inside
    rows, columns = neighbours.clip(0, size - 1).astype(np.int32)
    pixels, weights = rows[:, None] * size + columns, (row_weights[:, None] * column_weights).astype(np.float32)
    return Taps(pixels.reshape(16, -1), weights.reshape(16, -1))


def cubic_weight(distance: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Return the weight of a pixel at a distance in pixels, by the cubic convolution kernel."""
    x, a = np.abs(distance), CUBIC_A
    weight_up_to_1 = ((a + 2) * x - (a + 3)) * x**2 + 1
    weight_up_to_2 = a * (((x - 5) * x + 8) * x - 4)
    return np.where(x <= 1, weight_up_to_1, np.where(x < 2, weight_up_to_2, 0.0))


def resample_maps(maps: Float[Array, "b h h c"], taps: Taps) -> Float[Array, "b h h c"]:
    """Do the same as `input_image.resample`, as a product with a dense matrix, for small maps of many channels."""
    pixels = taps.pixel.shape[1]
    matrix = np.zeros((pixels, pixels), np.float32)
    np.add.at(matrix, (np.arange(pixels)[None], taps.pixel), taps.weight)
    return jnp.einsum("pq,bqc->bpc", matrix, maps.reshape(len(maps), -1, maps.shape[-1])).reshape(maps.shape)


def resize_maps(maps: Float[Array, "b h h c"], size: int) -> Float[Array, "b {size} {size} c"]:
    """Return maps resampled to another size. The corners of both sizes coincide, and zeros surround the maps."""
    old_size = maps.shape[1]
    source = np.linspace(0, old_size - 1, size)  # row, or column, in the old maps
    weights = cubic_weight(source[:, None] - np.arange(old_size)).astype(np.float32)
    return jnp.einsum("ip,jq,bpqc->bijc", weights, weights, maps)


def grey_image(scan: Scan) -> UInt8[np.ndarray, "151 151"]:
    """Return a scan's density image as grey values. Raises ValueError if it has another image or shows no place."""
    if scan.points is not None:
        check_cloud(scan.points, name=scan.name)
    check_ready_made(scan, "density")
    counts = picture(scan, None)[0]
    if counts.shape != (DENSITY_SIZE, DENSITY_SIZE):
        expected = f"a density image of {DENSITY_SIZE} x {DENSITY_SIZE} pixels"
        raise ValueError(f"{scan.name}: expected {expected}, found {counts.shape}")
    return np.rint(counts * (255 / DENSITY_MAX_COUNT)).clip(0, 255).astype(np.uint8)


def rotate_images(key: Array, images: Num[Array, "b h h"]) -> Num[Array, "b h h"]:
    """Rotate each image about its centre by a random angle, bilinearly, with zeros outside."""
    angles = jax.random.uniform(key, (len(images),), maxval=2 * jnp.pi)
    rotated = rotate_image(images.astype(jnp.float32), angles)
    return jnp.rint(rotated).astype(images.dtype)


SAMPLING = TupleConfig(positive_m=5.0, negative_m=7.0, mining="hardest", hardest=10, refresh_steps=25, mined_places=256)
"""Describing 256 places every 25 steps takes about an eighth of the training time."""


def _method(name: str, source: str, *, rotations: int, tuples: int) -> LearnedMethod:
    """Return the method whose network encodes this number of rotations of each image."""
    network = REIN(rotations)
    return LearnedMethod(
        name=name,
        source=source,
        licence="MIT",
        takes="images",
        weights=1_364_288,
        network=network,
        prepare=grey_image,
        rotate_inputs=rotate_images,
        loss=functools.partial(triplet, margin=MARGIN, closest_positive=False),
        recipe=Recipe(SAMPLING, tuples, learning_rates=(3e-5, 1e-4, 3e-4)),
        start=functools.partial(fit_clusters, network),
    )


BEVPLACE = _method("bevplace++", 'Luo et al., "BEVPlace++", T-RO 2025, trained from scratch', rotations=8, tuples=2)
RESNET34_NETVLAD = _method(
    "resnet34-netvlad",
    'Luo et al., "BEVPlace", ICCV 2023, ablation ResNet-34 + NetVLAD, trained from scratch',
    rotations=1,
    tuples=4,
)
"""The same network with one rotation. A step has 4 tuples (48 images) instead of 2."""
