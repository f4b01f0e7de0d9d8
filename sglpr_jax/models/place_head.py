"""The place head: from the backbone's feature map to a descriptor (section 4.1.2)."""

import flax.linen as nn
from jaxtyping import Array, Float

from sglpr_jax.models.cbam import CBAM
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.layers import LayerNorm, convolution, l2_normalize
from sglpr_jax.models.mean_pooling import MeanPooling
from sglpr_jax.models.netvlad import NetVLAD
from sglpr_jax.models.spectrum import Spectrum


class PlaceHead(nn.Module):
    """CBAM, convolutions that shrink the map and widen its channels, NetVLAD, L2 normalisation (table 4: or less)."""

    config: HeadConfig
    circular: bool = False
    """The left and right borders of the map are neighbours."""

    @nn.compact
    def __call__(
        self, features: Float[Array, "b h w c"]
    ) -> tuple[Float[Array, "b {self.config.descriptor_size}"], dict[str, Float[Array, "b _ _ _"]]]:
        """Descriptors of length 1, and the maps on the way by name."""
        x, seen = features, {}
        if self.config.cbam:
            x = seen["cbam"] = CBAM(self.config.cbam_reduction, name="cbam")(x)
        shapes = zip(self.config.channels, self.config.kernels, self.config.strides, strict=True)
        for i, (channels, kernel, stride) in enumerate(shapes):
            x = convolution(x, channels, kernel, stride, circular=self.circular, name=f"convolution_{i}")
            x = seen[f"head_convolution{i}"] = nn.relu(LayerNorm(name=f"norm_{i}")(x))
        return l2_normalize(self._pool(x)), seen

    def _pool(self, x: Float[Array, "b h w c"]) -> Float[Array, "b d"]:
        config = self.config
        if config.pooling == "spectrum":
            size, channels = config.descriptor_size, config.spectrum_channels
            return Spectrum(channels, config.frequencies, size, name="spectrum")(x)
        locals_ = x.reshape(len(x), -1, x.shape[-1])
        if config.pooling == "mean":
            return MeanPooling(config.descriptor_size, name="mean_pooling")(locals_)
        return NetVLAD(config.clusters, config.descriptor_size, name="netvlad")(locals_)
