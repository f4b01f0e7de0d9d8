"""Maps of the strength of the network's features, on the grid of the image."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from sglpr_jax.models.input_image import field_of_view, from_polar
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import forward


def heat_maps(
    params: Params, bev: Num[Array | np.ndarray, "h w"], labels: Int[Array | np.ndarray, "h w"] | None = None
) -> Mapping[str, Float[np.ndarray, "h w"]]:
    """Compute the root mean square over the channels of some feature maps, scaled from 0 to 1.

    The model selects the feature maps (`config.pictures`): those of its backbone, and the first of its place head.

    Arguments:
      params: Weights of the model.
      bev: One image of point counts.
      labels: Map of classes, if `describe` needs it.

    Returns:
      Maps by title, with NaN outside the field of view of the model.
    """
    found = jax.device_get(_maps(params, jnp.asarray(bev), None if labels is None else jnp.asarray(labels)))
    return {title: _scaled(found[name]) for title, name in params.config.pictures.items()}


def _scaled(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    low, high = np.nanmin(values), np.nanmax(values)
    return (values - low) / max(high - low, 1e-9)


@jax.jit
def _maps(params: Params, bev: Num[Array, "h w"], labels: Int[Array, "h w"] | None) -> dict[str, Float[Array, "h w"]]:
    config, grid = params.config, params.config.grid
    outputs = forward(params, bev, labels, segment=0)

    def on_grid(features: Float[Array, "1 p q c"]) -> Float[Array, "h w"]:
        strength = jnp.sqrt(jnp.mean(features.astype(jnp.float32) ** 2, axis=-1, keepdims=True))
        if config.polar:
            whole = from_polar(strength, grid)[0, ..., 0]
        else:
            whole = jax.image.resize(strength[0, ..., 0], (grid.height, grid.width), "linear")
        return jnp.where(field_of_view(config)[0], whole, jnp.nan)

    return {name: on_grid(outputs.intermediates[name]) for name in config.pictures.values()}
