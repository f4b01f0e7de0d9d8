"""From an image to maps of how strongly the features of the network answer, on the grid of the image."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from sglpr_jax.models.polar import from_polar
from sglpr_jax.models.sglpr import Params, forward

NAMES = {
    "patch_embed": "patches",
    "bottleneck_norm": "bottleneck",
    "norm_up": "decoder",
    "cbam": "CBAM",
}
"""Which intermediates of the network are shown, and as what."""


def heat_maps(params: Params, bev: Num[Array | np.ndarray, "h w"]) -> Mapping[str, Float[np.ndarray, "h w"]]:
    """Return by name the root mean square over the channels of a feature map, from 0 to 1.

    A polar map is read back onto the grid; beyond its circle it is 0.
    """
    found = jax.device_get(_maps(params, jnp.asarray(bev)))
    return {name: values / max(float(values.max()), 1e-9) for name, values in found.items()}


@jax.jit
def _maps(params: Params, bev: Num[Array, "h w"]) -> dict[str, Float[Array, "h w"]]:
    grid = params.config.grid
    outputs = forward(params, bev[None], segment=0)

    def on_grid(features: Float[Array, "1 p q c"]) -> Float[Array, "h w"]:
        strength = jnp.sqrt(jnp.mean(features**2, axis=-1, keepdims=True))
        if params.config.polar:
            return from_polar(strength, grid)[0, ..., 0]
        return jax.image.resize(strength[0, ..., 0], (grid.height, grid.width), "linear")

    return {shown: on_grid(outputs.intermediates[name]) for name, shown in NAMES.items()}
