"""Place head: CBAM (Woo et al. 2018), convolutions, pooling by NetVLAD or mean, and whitening."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sglpr_jax.models import initial
from sglpr_jax.models.circular import CircularBlock, block_means
from sglpr_jax.models.config import HeadConfig, ModelConfig
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.initial import torch_uniform
from sglpr_jax.models.input_image import backbone_view
from sglpr_jax.models.layers import LayerNorm, Linear, l2_normalize, maximum, residual_sums, weight
from sglpr_jax.models.swin import PatchEmbed


class ChannelGate(nn.Module):
    """x * sigmoid(mlp(mean of x) + mlp(maximum of x)), pooled over the image; one shared two-layer MLP."""

    reduction: int = 16

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        c = x.shape[-1]
        pooled = jnp.stack([x.mean((1, 2)), maximum(x, (1, 2))], axis=1)
        hidden = nn.relu(Linear(max(1, c // self.reduction), name="mlp_in")(pooled))
        logits = Linear(c, name="mlp_out")(hidden).sum(1)
        return x * nn.sigmoid(logits)[:, None, None]


class SpatialGate(nn.Module):
    """x * sigmoid(7 x 7 convolution of [maximum, mean] over channels).

    The convolution has a bias instead of the original's batch norm, which can be folded into it.
    """

    circular: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        pooled = jnp.stack([maximum(x, (-1,)), x.mean(-1)], axis=-1)
        convolution = Convolution(1, 7, circular=self.circular, kernel_init=torch_uniform, name="convolution")
        return x * nn.sigmoid(convolution(pooled))


class CBAM(nn.Module):
    """Channel gate, then spatial gate."""

    reduction: int = 16
    circular: bool = False

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


class GatedNetVLAD(nn.Module):
    """NetVLAD (soft assignment of features to clusters, residual sums), a linear layer and context gating.

        a[n, k] = softmax over k of (x W + bias)

        vlad = residual_sums(x, a, centres), flattened, L2-normalised

        y = vlad * hidden + bias;  output = y * sigmoid(y G + bias)

    Biases replace PointNetVLAD's batch norm, so that an output does not depend on the rest of its batch. The sums over
    the features and all later steps are float32.
    """

    clusters: int
    output: int

    @nn.compact
    def __call__(self, features: Float[Array, "b n d"]) -> Float[Array, "b {self.output}"]:
        d = features.shape[-1]
        weights_init = initial.normal(d**-0.5)
        logits = Linear(self.clusters, kernel_init=weights_init, name="assignment")(features)
        centres = weight(self, "centres", weights_init, (d, self.clusters))
        vlad = residual_sums(features, nn.softmax(logits.astype(jnp.float32)), centres).reshape(features.shape[0], -1)
        y = Linear(self.output, kernel_init=weights_init, name="hidden")(l2_normalize(vlad))
        gate_init = initial.normal(self.output**-0.5)
        return y * nn.sigmoid(Linear(self.output, kernel_init=gate_init, name="gate")(y))


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
    planes = [image] if "counts" in config.head.input else []
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
        config, x, maps = self.config, features, {}
        if config.cbam:
            x = maps["cbam"] = CBAM(config.cbam_reduction, bool(config.means), name="cbam")(x)
        for i, (channels, kernel, stride) in enumerate(
            zip(config.channels, config.kernels, config.strides, strict=True)
        ):
            if config.means:
                x = block_means(CircularBlock(channels, stride, name=f"block_{i}")(x), 1, config.means[i])
            else:
                strides, name = (stride, stride), f"convolution_{i}"
                x = Convolution(channels, kernel, strides, circular=self.circular, name=name)(x)
                x = nn.relu(LayerNorm(name=f"norm_{i}")(x))
            maps[f"head_convolution{i}"] = x
        local_features = x.reshape(x.shape[0], -1, x.shape[-1])
        if config.pooling == "mean":
            pooled = MeanPooling(config.descriptor_size, name="mean_pooling")(local_features)
        else:
            pooled = GatedNetVLAD(config.clusters, config.descriptor_size, name="netvlad")(local_features)
        descriptor = l2_normalize(pooled)
        return Whitening(name="whiten")(descriptor) if config.whiten else descriptor, maps
