"""The images of a step are turned at random, and their labels count where the network sees."""

import dataclasses

import jax
import numpy as np

from sglpr_jax.training.step import _angles, _chunks


def chunks_of(batch, config):
    return _chunks(batch, *jax.random.split(jax.random.key(0)), config)


def test_rotations_follow_the_key_and_can_be_turned_off(config, make_batch):
    batch = make_batch(0)
    angle_key, other_key = jax.random.split(jax.random.key(0))
    turned, again, other = (
        _chunks(batch, key, other_key, config).images for key in (angle_key, angle_key, jax.random.key(5))
    )
    np.testing.assert_array_equal(turned, again)
    assert (turned != other).any(axis=(0, 2, 3)).all()
    still = [
        _chunks(batch, key, other_key, dataclasses.replace(config, rotate=False)).images
        for key in (angle_key, jax.random.key(5))
    ]
    np.testing.assert_array_equal(*still)


def test_of_a_share_of_the_places_the_rotation_is_a_quarter_turn_or_more(config, make_batch):
    config = dataclasses.replace(config, quarter_turns=0.5)
    keys = jax.random.split(jax.random.key(0), 60)
    quarters = np.stack([_angles(key, config) for key in keys]) / (np.pi / 2)
    whole = np.abs(quarters - np.round(quarters)) < 1e-5
    assert 0.4 < whole.mean() < 0.6
    assert np.bincount(np.round(quarters[whole]).astype(int), minlength=4).min() > whole.sum() / 6
    assert np.ptp(np.histogram(quarters[~whole], bins=4, range=(0, 4))[0]) < (~whole).sum() / 6
    batch = make_batch(0, images=True)
    all_quarters = dataclasses.replace(config, quarter_turns=1.0)
    for image, turned in zip(batch.images, chunks_of(batch, all_quarters).images[0], strict=True):
        assert any(np.allclose(np.rot90(image, k), turned, atol=1e-4) for k in range(4))


def test_labels_count_only_where_the_network_sees(config, make_batch):
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, field="circle"))
    maps = np.asarray(chunks_of(make_batch(0), config).maps)
    down, right = np.mgrid[:16, :16] - 7.5
    outside = np.hypot(down, right) >= 8
    assert (maps[..., outside] == 0).all()
    assert (maps[..., ~outside] > 0).any()
