"""The place head: from the backbone's feature map to a descriptor (section 4.1.2)."""

import flax.linen as nn
from jaxtyping import Array, Float

from sglpr_jax.models.cbam import CBAM
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.layers import LayerNorm, l2_normalize
from sglpr_jax.models.netvlad import NetVLAD


class PlaceHead(nn.Module):
    """CBAM, convolutions that shrink the map and widen its channels, NetVLAD, L2 normalisation."""

    config: HeadConfig

    @nn.compact
    def __call__(
        self, features: Float[Array, "b h w c"]
    ) -> tuple[Float[Array, "b {self.config.descriptor_size}"], dict[str, Float[Array, "b _ _ _"]]]:
        """Descriptors of length 1, and the maps on the way by name."""
        x = CBAM(self.config.cbam_reduction, name="cbam")(features)
        seen = {"cbam": x}
        shapes = zip(self.config.channels, self.config.kernels, self.config.strides, strict=True)
        for i, (channels, kernel, stride) in enumerate(shapes):
            x = _convolution(channels, kernel, stride, name=f"convolution_{i}")(x)
            x = seen[f"head_convolution{i}"] = nn.relu(LayerNorm(name=f"norm_{i}")(x))
        locals_ = x.reshape(len(x), -1, x.shape[-1])
        vector = NetVLAD(self.config.clusters, self.config.descriptor_size, name="netvlad")(locals_)
        return l2_normalize(vector), seen


def _convolution(channels: int, kernel: int, stride: int, *, name: str) -> nn.Conv:
    """He-initialised; patches side by side (kernel = stride) need no border, others PyTorch's border of kernel // 2."""
    padding = 0 if kernel == stride else kernel // 2
    return nn.Conv(channels, (kernel, kernel), stride, padding, kernel_init=nn.initializers.he_normal(), name=name)
