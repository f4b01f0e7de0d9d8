"""The public API as a whole: documented, in one style, and enough for the README's lines of Python."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sglpr_jax

PUBLIC = [(name, getattr(sglpr_jax, name)) for name in sglpr_jax.__all__]
CALLABLES = [(name, member) for name, member in PUBLIC if callable(member)]
FUNCTIONS = [(name, inspect.signature(member)) for name, member in CALLABLES if not inspect.isclass(member)]
INPUTS_NOT_OPTIONS = {
    ("simulate_recording", "name"),
    ("open_recording", "name"),
    ("describe", "labels"),
    ("forward", "labels"),
    ("evaluate", "protocols"),
    ("taxonomy", "categories"),
}


def test_everything_public_is_documented():
    assert len(set(sglpr_jax.__all__)) == len(sglpr_jax.__all__)
    for name, member in CALLABLES:
        said = inspect.getdoc(member) or ""
        first = said.splitlines()[0] if said else ""
        assert len(first) > 20 and not first.startswith(f"{name}("), f"{name}: a dataclass's generated docstring"


def test_key_comes_first_and_options_are_named():
    for name, signature in FUNCTIONS:
        for position, parameter in enumerate(signature.parameters.values()):
            if parameter.name == "key" and parameter.default is parameter.empty:
                assert position == 0
            elif parameter.default is not parameter.empty and (name, parameter.name) not in INPUTS_NOT_OPTIONS:
                assert parameter.kind is parameter.KEYWORD_ONLY, (name, parameter.name)


@pytest.mark.slow
def test_the_readmes_lines(tmp_path):
    head = sglpr_jax.HeadConfig(channels=(8,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4)
    grid = sglpr_jax.Grid(resolution_m=3.2, height=16, width=16)
    backbone = sglpr_jax.SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4)
    config = sglpr_jax.ModelConfig(grid=grid, backbone=backbone, head=head)
    params = sglpr_jax.init(jax.random.key(0), config=config)
    rng = np.random.default_rng(0)
    cloud = np.concatenate([rng.normal(scale=8, size=(2000, 3)), rng.random((2000, 1))], axis=1)
    cloud.astype("<f4").tofile(tmp_path / "000000.bin")
    sglpr_jax.save(params, tmp_path / "run" / "weights")

    loaded = sglpr_jax.load(tmp_path / "run")
    points = sglpr_jax.read_scan(str(tmp_path / "000000.bin"))  # text or a Path
    bev = sglpr_jax.scan_image(points, loaded.config)
    np.testing.assert_array_equal(bev, sglpr_jax.rasterize(points, grid=loaded.config.grid))
    descriptor = sglpr_jax.describe(loaded, bev)

    assert descriptor.shape == (256,) and descriptor.dtype == jnp.float32
    np.testing.assert_allclose(jnp.linalg.norm(descriptor), 1, rtol=1e-5)
    np.testing.assert_array_equal(sglpr_jax.describe(params, bev), descriptor)
    turned = sglpr_jax.rotate_points(points, jnp.float32(1.0))
    other = sglpr_jax.describe(params, sglpr_jax.rasterize(turned, grid=loaded.config.grid))
    assert np.abs(other - descriptor).max() > 1e-4


def test_an_unknown_preset_lists_those_that_exist():
    with pytest.raises(ValueError, match=r"\(sglpr, .*'smal'"):
        sglpr_jax.init(jax.random.key(0), preset="smal")
