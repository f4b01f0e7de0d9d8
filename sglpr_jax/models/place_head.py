"""Place head: CBAM, convolutions, pooling by NetVLAD or mean, and whitening."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sglpr_jax.models import initial
from sglpr_jax.models.cbam import CBAM
from sglpr_jax.models.circular import CircularBlock, block_means
from sglpr_jax.models.config import HeadConfig, ModelConfig
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.input_image import backbone_view
from sglpr_jax.models.layers import LayerNorm, l2_normalize, weight
from sglpr_jax.models.netvlad import GatedNetVLAD, MeanPooling
from sglpr_jax.models.swin import PatchEmbed


class Whitening(nn.Module):
    """Linear layer and L2 normalisation. Its initial weights leave a descriptor of length 1 unchanged."""

    @nn.compact
    def __call__(self, descriptor: Float[Array, "b d"]) -> Float[Array, "b d"]:
        d = descriptor.shape[-1]
        kernel = weight(self, "kernel", initial.identity, (d, d))
        bias = weight(self, "bias", initial.zeros, (d,))
        return l2_normalize(jnp.matmul(descriptor, kernel, precision=jax.lax.Precision.HIGHEST) + bias[None])


def input_without_backbone(
    image: Float[Array, "b h w c"], labels: Int[Array, "b h w"] | None, config: ModelConfig
) -> Float[Array, "b p q _"]:
    """Return the input of a place head without backbone (table 6): point counts, one-hot labels, or both as channels.

    With `head.tap="tokens"` a patch embedding follows. This layer belongs to the calling module.
    """
    channels = [image] if "counts" in config.head.input else []
    if config.head.reads_labels:
        channels.append(jax.nn.one_hot(labels, config.classes))
    pixels = backbone_view(jnp.concatenate(channels, axis=-1), config)
    if config.head.tap == "pixels":
        return pixels
    return PatchEmbed(config.backbone.width, config.backbone.token, name="patch_embed")(pixels)


class PlaceHead(nn.Module):
    """CBAM, convolutions that reduce the map, NetVLAD or mean, L2 normalisation, and whitening if configured."""

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
            x = maps["cbam"] = CBAM(config.cbam_reduction, circular=self.circular, name="cbam")(x)
        sizes = zip(config.channels, config.kernels, config.strides, strict=True)
        for i, (channels, kernel, stride) in enumerate(sizes):
            if config.means:
                x = CircularBlock(channels, stride, name=f"block_{i}")(x)
                x = block_means(x, 1, config.means[i])
            else:
                options = {"circular": self.circular, "name": f"convolution_{i}"}
                x = Convolution(channels, kernel, (stride, stride), **options)(x)
                x = nn.relu(LayerNorm(name=f"norm_{i}")(x))
            maps[f"head_convolution{i}"] = x
        local_features = x.reshape(x.shape[0], -1, x.shape[-1])
        if config.pooling == "mean":
            pooled = MeanPooling(config.descriptor_size, name="mean_pooling")(local_features)
        else:
            pooled = GatedNetVLAD(config.clusters, config.descriptor_size, name="netvlad")(local_features)
        descriptor = l2_normalize(pooled)
        return Whitening(name="whiten")(descriptor) if config.whiten else descriptor, maps
