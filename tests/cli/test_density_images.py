"""A model made for density images sees raw scans as such, in bin/embed."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.bev import even_cells
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import rotated
from sglpr_jax.models.params import Params

ROWS = np.arange(16)


@pytest.fixture(scope="module")
def params(random_params) -> Params:
    tiny = sglpr_jax.model_preset("tiny")
    head = dataclasses.replace(tiny.head, channels=(16,), kernels=(4,), strides=(4,))
    grid = sglpr_jax.Grid(resolution_m=0.4, height=64, width=64)
    backbone = dataclasses.replace(tiny.backbone, depths=(1,), heads=(2,))
    return random_params(
        dataclasses.replace(tiny, grid=grid, backbone=backbone, categories=0, head=head, image="density")
    )


def described(params: Params, recording: Recording, angles: np.ndarray) -> np.ndarray:
    """The descriptors of the first scans, by the library."""
    clouds = [rotated(recording.points(int(row)), float(angle)) for row, angle in zip(ROWS, angles, strict=True)]
    whole = [sglpr_jax.density_bev(cloud) for cloud in clouds]
    images = jnp.stack([sglpr_jax.scan_image(cloud, params.config) for cloud in clouds])
    np.testing.assert_array_equal(images, even_cells(jnp.stack(whole))[:, 44:108, 44:108])
    assert (images.max((1, 2)) > 0).all()
    return np.asarray(sglpr_jax.describe(params, images))


@pytest.mark.slow
def test_embedding_makes_density_images_of_turned_points(command, params, town, tmp_path):
    folder, out = sglpr_jax.save(params, tmp_path / "weights"), tmp_path / "08.npz"
    ended = command("embed", "--weights", folder, "--data", town, "--seq", "08", "--out", out, "--rotate", "--seed", 1)
    assert ended.status == 0, ended.error
    recording = sglpr_jax.open_recording(town, "08")
    angles = np.random.default_rng(1).uniform(0, 2 * np.pi, len(recording))[ROWS]
    found = sglpr_jax.DescriptorFile.load(out)
    np.testing.assert_allclose(found.descriptors[ROWS], described(params, recording, np.float32(angles)), atol=1e-5)
    assert found.config["model"]["image"] == "density"
