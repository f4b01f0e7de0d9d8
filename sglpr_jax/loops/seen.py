"""Description of a scan for the loop search: its descriptor and its density image."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Num, UInt8

from sglpr_jax.bev import centre_crop, even_cells
from sglpr_jax.data.density_grid import MAX_COUNT
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.data.views import check_ready_made, image_view, picture, view
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe


class Seen(NamedTuple):
    """Descriptor and image of a scan or ready-made image."""

    descriptor: Float32[np.ndarray, " d"]
    image: UInt8[np.ndarray, "n n"]
    """Density image."""
    mounting: Mounting | None
    """Mounting of the sensor. Descriptor and image are gravity-aligned."""


def described(params: Params, record: Record) -> Seen:
    """Descriptor and 8-bit density image of a scan or image."""
    model = params.config
    check_ready_made(record, model.image)
    whole, _ = picture(record, None)
    if record.points is None or model.image == "density":
        bev = image_view(whole, None, model.grid).image
    else:
        bev = view(record, model.grid, image=model.image).image
    return Seen(np.asarray(describe(params, bev)), _kept(whole), record.mounting)


def _kept(image: Num[np.ndarray, "h w"]) -> UInt8[np.ndarray, "n n"]:
    """Central square of an image, with an even number of cells, as 8 bits."""
    even = even_cells(jnp.asarray(image, jnp.float32))
    size = min(even.shape)
    grey = np.asarray(centre_crop(even, height=size, width=size)) * (255 / MAX_COUNT)
    return np.round(grey).clip(0, 255).astype(np.uint8)


def square_image(record: Record) -> UInt8[np.ndarray, "n n"]:
    """Image for the verification of loops: the density image or the ready-made image, as 8 bits."""
    return _kept(picture(record, None)[0])
