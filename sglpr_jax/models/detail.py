"""The image itself beside the features, for the segmentation head alone."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.layers import Linear, gelu

_LOCAL_CHANNELS = 16
_LOCAL_CELLS = 5


class Detail(nn.Module):
    """Mix the features of every pixel with what the image shows around it.

    A patch's token cannot say which of its many cells held how many points; here the head is told.
    """

    width: int
    circular: bool

    @nn.compact
    def __call__(self, pixels: Float[Array, "b h w c"], image: Float[Array, "b h w i"]) -> Float[Array, "b h w d"]:
        around = _LOCAL_CELLS // 2
        columns = "wrap" if self.circular else "constant"
        image = jnp.pad(image, ((0, 0), (around, around), (0, 0), (0, 0)))
        image = jnp.pad(image, ((0, 0), (0, 0), (around, around), (0, 0)), mode=columns)
        local = nn.Conv(_LOCAL_CHANNELS, (_LOCAL_CELLS, _LOCAL_CELLS), padding="VALID", name="local")(image)
        both = jnp.concatenate([pixels, nn.relu(local)], axis=-1)
        return gelu(Linear(self.width, name="mix")(both))
