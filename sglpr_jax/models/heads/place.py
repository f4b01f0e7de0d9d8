"""Place head: from the backbone's feature map to a descriptor (section 4.1.2)."""

import flax.linen as nn
from jaxtyping import Array, Float

from sglpr_jax.models.backbones.circular import CircularBlock, block_means
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.heads.cbam import CBAM
from sglpr_jax.models.heads.mean_pooling import MeanPooling
from sglpr_jax.models.heads.netvlad import NetVLAD
from sglpr_jax.models.heads.spectrum import Spectrum
from sglpr_jax.models.heads.whitening import Whitening
from sglpr_jax.models.layers import LayerNorm, l2_normalize


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
        """Applies the i-th convolution, its layer norm and ReLU."""
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
