import dataclasses

import numpy as np
import pytest

from sglpr_jax.bev import Grid
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.retrieval.heat_maps import heat_maps


@pytest.mark.parametrize("polar", [None, (8, 32)])
def test_maps_lie_on_the_grid_of_the_image_and_follow_it(random_params, polar):
    config = dataclasses.replace(
        model_preset("tiny"),
        grid=Grid(resolution_m=1.0, height=16, width=16),
        depths=(1,),
        heads=(2,),
        head=HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4),
        polar=polar,
        field="circle",
    )
    params = random_params(config)
    image = np.zeros((16, 16), np.int32)
    image[2:6, 7:12] = 5
    found, other = heat_maps(params, image), heat_maps(params, image[::-1].copy())
    assert list(found) == ["encoder, first", "encoder, last", "decoder", "CBAM"]
    for name, values in found.items():
        assert values.shape == (16, 16)
        assert np.isnan(values[0, 0]) and np.isfinite(values[4, 8])
        assert (np.nanmin(values), np.nanmax(values)) == (0, 1)
        assert np.nanmax(np.abs(values - other[name])) > 0.1
