"""From an image to maps of how strongly the features of the network answer, on the grid of the image."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from sglpr_jax.models.polar import from_polar
from sglpr_jax.models.sglpr import Params, field_of_view, forward


def heat_maps(
    params: Params, bev: Num[Array | np.ndarray, "h w"], labels: Int[Array | np.ndarray, "h w"] | None = None
) -> Mapping[str, Float[np.ndarray, "h w"]]:
    """Return by name the root mean square over the channels of a feature map, from 0 to 1; NaN where it does not look.

    The maps are those after the first and the last stage of the encoder, after the decoder, and after CBAM, of those
    that the model has, and after the first convolution of a place head without CBAM. `labels` as `describe` needs them.
    """
    found = jax.device_get(_maps(params, jnp.asarray(bev), None if labels is None else jnp.asarray(labels)))
    return {name: _scaled(found[layer]) for name, layer in _layers(params).items()}


def _layers(params: Params) -> dict[str, str]:
    """Return which intermediate is shown under which name; a normalised one would be as strong everywhere."""
    last = len(params.config.depths) - 1
    backbone = {"encoder, first": "enc0_out", "encoder, last": f"enc{last}_out", "decoder": f"dec{last}_out"}
    head = {"CBAM": "cbam"} if params.config.head.cbam else {"place head, first": "head_convolution0"}
    return backbone | head if params.config.head.input == "features" else head


def _scaled(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    low, high = np.nanmin(values), np.nanmax(values)
    return (values - low) / max(high - low, 1e-9)


@jax.jit
def _maps(params: Params, bev: Num[Array, "h w"], labels: Int[Array, "h w"] | None) -> dict[str, Float[Array, "h w"]]:
    grid = params.config.grid
    outputs = forward(params, bev, labels, segment=0)

    def on_grid(features: Float[Array, "1 p q c"]) -> Float[Array, "h w"]:
        strength = jnp.sqrt(jnp.mean(features.astype(jnp.float32) ** 2, axis=-1, keepdims=True))
        if params.config.polar:
            whole = from_polar(strength, grid)[0, ..., 0]
        else:
            whole = jax.image.resize(strength[0, ..., 0], (grid.height, grid.width), "linear")
        return jnp.where(field_of_view(params.config)[0], whole, jnp.nan)

    return {layer: on_grid(outputs.intermediates[layer]) for layer in set(_layers(params).values())}
