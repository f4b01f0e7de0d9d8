"""A model made for density images sees raw scans as such, in bin/embed as in training."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.bev import even_cells
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import rotated
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.params import Params
from sglpr_jax.training.batches import batches_of, tuple_pool
from sglpr_jax.training.config import LossConfig, TrainConfig
from sglpr_jax.training.validation import describe_places

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
@pytest.mark.parametrize("seed", [(), ("--rotate", "--seed", 1)])
def test_embedding_makes_density_images_of_turned_points(command, params, town, tmp_path, seed):
    folder, out = sglpr_jax.save(params, tmp_path / "weights"), tmp_path / "08.npz"
    ended = command("embed", "--weights", folder, "--data", town, "--seq", "08", "--out", out, *seed)
    assert ended.status == 0, ended.error
    recording = sglpr_jax.open_recording(town, "08")
    angles = np.random.default_rng(1).uniform(0, 2 * np.pi, len(recording))[ROWS] * bool(seed)
    found = sglpr_jax.DescriptorFile.load(out)
    np.testing.assert_allclose(found.descriptors[ROWS], described(params, recording, np.float32(angles)), atol=1e-5)
    assert found.config["model"]["image"] == "density"


@pytest.mark.slow
def test_training_sees_the_same_images(params, town):
    recording = sglpr_jax.open_recording(town, "08")
    config = TrainConfig(
        model=params.config,
        sampling=TupleConfig(negatives=2, positive_m=16.0),
        loss=LossConfig(ce_weight=0.0, dice_weight=0.0),
    )
    pool = tuple_pool([recording], config)
    batch = batches_of([recording], pool, config).batch(0)
    rows = pool.draw(seed=config.seed, step=0, tuples=1).reshape(-1)
    np.testing.assert_array_equal(batch.images, [sglpr_jax.density_bev(recording.points(int(row))) for row in rows])
    found = describe_places(params, [recording], pool, ROWS, np.zeros(16), config)
    np.testing.assert_allclose(found, described(params, recording, np.zeros(16)), atol=1e-4)
