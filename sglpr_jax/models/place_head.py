"""Place head: CBAM (Woo et al. 2018), convolutions, pooling by NetVLAD, mean or spectrum, and whitening."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sglpr_jax.models import initial
from sglpr_jax.models.circular import CircularBlock, block_means
from sglpr_jax.models.config import HeadConfig, ModelConfig
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.initial import torch_uniform
from sglpr_jax.models.input_image import backbone_view
from sglpr_jax.models.layers import LayerNorm, Linear, l2_normalize, weight
from sglpr_jax.models.swin import PatchEmbed

ROUNDING = 1e-6
FLOOR = 1e-6
"""Added to squared amplitudes, because the gradient of a square root at zero is not finite."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def largest(x: Float[Array, "*dims"], axes: tuple[int, ...]) -> Float[Array, "*rest"]:
    """Maximum over some axes. All entries within rounding of the maximum share its gradient.

    The gradient of `jnp.max` goes to the entries equal to the maximum. XLA may compute `x` again for the gradient and
    round it differently. Then no entry is equal, and the gradient is 0 / 0.
    """
    return x.max(axes)


@largest.defjvp
def _largest_jvp(axes, primals, tangents):
    (x,), (dx,) = primals, tangents
    y = x.max(axes, keepdims=True)
    hit = x >= y - ROUNDING * (1 + jnp.abs(y))
    return y.squeeze(axes), jnp.where(hit, dx, 0).sum(axes) / jnp.maximum(hit.sum(axes), 1)


class ChannelGate(nn.Module):
    """x * sigmoid(mlp(mean of x) + mlp(maximum of x)), pooled over the image; one shared two-layer MLP."""

    reduction: int = 16

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        c = x.shape[-1]
        pooled = jnp.stack([x.mean((1, 2)), largest(x, (1, 2))], axis=1)
        hidden = nn.relu(Linear(max(1, c // self.reduction), name="mlp_in")(pooled))
        logits = Linear(c, name="mlp_out")(hidden).sum(1)
        return x * nn.sigmoid(logits)[:, None, None]


class SpatialGate(nn.Module):
    """x * sigmoid(convolution of [maximum, mean] over channels), 7 x 7.

    The convolution has a bias instead of the original's batch norm, which can be folded into it. With `circular=True`
    the columns wrap around.
    """

    circular: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        pooled = jnp.stack([largest(x, (-1,)), x.mean(-1)], axis=-1)
        convolution = Convolution(1, 7, circular=self.circular, kernel_init=torch_uniform, name="convolution")
        return x * nn.sigmoid(convolution(pooled))


class CBAM(nn.Module):
    """Channel gate, then spatial gate."""

    reduction: int = 16
    circular: bool = False
    """Whether the left and right borders of the map are neighbours."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        return SpatialGate(self.circular, name="spatial")(ChannelGate(self.reduction, name="channel")(x))


class MeanPooling(nn.Module):
    """Mean of a set of local features, then a linear layer."""

    output: int

    @nn.compact
    def __call__(self, features: Float[Array, "b n d"]) -> Float[Array, "b {self.output}"]:
        weights_init = initial.normal(features.shape[-1] ** -0.5)
        return Linear(self.output, kernel_init=weights_init, name="linear")(features.astype(jnp.float32).mean(1))


class NetVLAD(nn.Module):
    """Soft assignment of features to clusters, sums of residuals per cluster, a linear layer and context gating.

        a[n, k] = softmax over k of (x W + bias)

        vlad[d, k] = sum over n of a[n, k] * (x[n, d] - centre[d, k]), L2-normalised over d, then as a whole

        y = vlad * hidden + bias;  output = y * sigmoid(y G + bias)

    Biases replace PointNetVLAD's batch norm, so that an output does not depend on the rest of its batch.
    """

    clusters: int
    output: int
    gating: bool = True

    @nn.compact
    def __call__(self, features: Float[Array, "b n d"]) -> Float[Array, "b {self.output}"]:
        """The sums over the features and all later steps are float32."""
        d = features.shape[-1]
        weights_init = initial.normal(d**-0.5)
        logits = Linear(self.clusters, kernel_init=weights_init, name="assignment")(features)
        assignment = nn.softmax(logits.astype(jnp.float32))
        centres = weight(self, "centres", weights_init, (d, self.clusters))
        weights = assignment.astype(features.dtype)
        residuals = jnp.einsum("bnd,bnk->bdk", features, weights, preferred_element_type=jnp.float32)
        residuals = residuals - assignment.sum(1)[:, None, :] * centres[None]
        vlad = l2_normalize(residuals, axis=1).reshape(features.shape[0], -1)
        y = Linear(self.output, kernel_init=weights_init, name="hidden")(l2_normalize(vlad))
        if not self.gating:
            return y
        gate_init = initial.normal(self.output**-0.5)
        return y * nn.sigmoid(Linear(self.output, kernel_init=gate_init, name="gate")(y))


class Spectrum(nn.Module):
    """Reduction of the channels, amplitudes of the lowest `frequencies` of each channel, a linear layer."""

    output: int
    channels: int = 256
    """Number of transformed channels: linear combinations of all channels at all radii."""
    frequencies: int = 32

    @nn.compact
    def __call__(self, features: Float[Array, "b r s c"]) -> Float[Array, "b {self.output}"]:
        """The transform and all later steps are float32. Frequency 0 is the mean."""
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


class Whitening(nn.Module):
    """Linear layer and L2 normalisation. It is the identity until it is fitted."""

    @nn.compact
    def __call__(self, descriptor: Float[Array, "b d"]) -> Float[Array, "b d"]:
        d = descriptor.shape[-1]
        kernel = weight(self, "kernel", initial.identity, (d, d))
        bias = weight(self, "bias", initial.zeros, (d,))
        return l2_normalize(jnp.matmul(descriptor, kernel, precision=jax.lax.Precision.HIGHEST) + bias[None])


def raw_input(
    image: Float[Array, "b h w c"], labels: Int[Array, "b h w"] | None, config: ModelConfig
) -> Float[Array, "b p q _"]:
    """Return planes of point counts, of labels (one plane for each class), or of both, in place of features.

    With the tap `tokens`, the head reads them through a patch embedding, a layer of the calling module.
    """
    planes = [image] if config.head.reads_counts else []
    if config.head.reads_labels:
        planes.append(jax.nn.one_hot(labels, config.classes))
    x = backbone_view(jnp.concatenate(planes, axis=-1), config)
    if config.head.tap == "pixels":
        return x
    return PatchEmbed(config.backbone.width, config.backbone.token, name="patch_embed")(x)


class PlaceHead(nn.Module):
    """CBAM, convolutions that reduce the map and add channels, NetVLAD, L2 normalisation. Table 4 leaves out parts."""

    config: HeadConfig
    circular: bool = False
    """Whether the left and right borders of the map are neighbours."""

    @nn.compact
    def __call__(
        self, features: Float[Array, "b h w c"]
    ) -> tuple[Float[Array, "b {self.config.descriptor_size}"], dict[str, Float[Array, "b _ _ _"]]]:
        """Returns descriptors of length 1, and the intermediate maps by name."""
        x, seen = features, {}
        if self.config.cbam:
            x = seen["cbam"] = CBAM(self.config.cbam_reduction, bool(self.config.means), name="cbam")(x)
        for i in range(len(self.config.channels)):
            x = seen[f"head_convolution{i}"] = self._convolve(x, i)
        descriptor = l2_normalize(self._pool(x))
        return Whitening(name="whiten")(descriptor) if self.config.whiten else descriptor, seen

    def _convolve(self, x: Float[Array, "b h w c"], i: int) -> Float[Array, "b _ _ _"]:
        config = self.config
        channels, kernel, stride = config.channels[i], config.kernels[i], config.strides[i]
        if config.means:
            return block_means(CircularBlock(channels, stride, name=f"block_{i}")(x), 1, config.means[i])
        strides, name = (stride, stride), f"convolution_{i}"
        x = Convolution(channels, kernel, strides, circular=self.circular, name=name)(x)
        return nn.relu(LayerNorm(name=f"norm_{i}")(x))

    def _pool(self, x: Float[Array, "b h w c"]) -> Float[Array, "b d"]:
        config = self.config
        if config.pooling == "spectrum":
            return Spectrum(config.descriptor_size, name="spectrum")(x)
        locals_ = x.reshape(x.shape[0], -1, x.shape[-1])
        if config.pooling == "mean":
            return MeanPooling(config.descriptor_size, name="mean_pooling")(locals_)
        return NetVLAD(config.clusters, config.descriptor_size, name="netvlad")(locals_)
