"""Window geometry and window attention: golden tables, inverses, and a plain numpy reference."""

import hashlib
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.swin import (
    BLOCKED,
    WindowAttention,
    join_windows,
    relative_position_index,
    shift_mask,
    split_windows,
)


def sha256(array):
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


@pytest.mark.parametrize("window", [4, 7])
def test_relative_position_index_is_the_references(window, golden):
    tables = golden("tables_masks")
    index = relative_position_index(window)
    np.testing.assert_array_equal(index, tables[f"rpi_w{window}"])
    assert sha256(index.astype(np.int64)) == json.loads(str(tables["hashes"]))[f"rpi_w{window}_int64"]


@pytest.mark.parametrize(("window", "size"), [(7, 14), (4, 8)])
def test_shift_mask_is_the_references(window, size, golden):
    tables, shift = golden("tables_masks"), window // 2
    hashes = json.loads(str(tables["hashes"]))
    name = f"mask_w{window}_s{shift}_r{size}"
    mask = shift_mask(size, size, window, (shift, shift), circular=False)
    np.testing.assert_array_equal(mask, tables[name])
    assert mask.sum() == hashes[f"{name}_blocked_count"]
    assert sha256(np.where(mask, BLOCKED, 0.0).astype(np.float32)) == hashes[f"{name}_float32"]


def test_windows_of_a_rectangular_map_are_its_tiles_and_join_to_it_again():
    image = np.arange(2 * 6 * 9 * 5, dtype=np.float32).reshape(2, 6, 9, 5)
    windows = split_windows(jnp.asarray(image), 3)
    for n, (b, i, j) in enumerate(np.ndindex(2, 2, 3)):
        tile = image[b, 3 * i : 3 * i + 3, 3 * j : 3 * j + 3].reshape(9, 5)
        np.testing.assert_array_equal(windows[n], tile)
    np.testing.assert_array_equal(join_windows(windows, 6, 9), image)


def numpy_attention(params, windows, blocked, heads):
    n, t, c = windows.shape
    qkv = windows @ params["qkv"]["kernel"] + params["qkv"]["bias"]
    q, k, v = qkv.reshape(n, t, 3, heads, c // heads).transpose(2, 0, 3, 1, 4)
    scores = q @ k.swapaxes(-1, -2) * (c // heads) ** -0.5
    scores += params["position_bias"][relative_position_index(round(t**0.5))].transpose(2, 0, 1)
    scores += np.where(blocked, BLOCKED, 0.0)[np.arange(n) % len(blocked)][:, None]
    weights = np.exp(scores - scores.max(-1, keepdims=True))
    weights /= weights.sum(-1, keepdims=True)
    mixed = (weights @ v).transpose(0, 2, 1, 3).reshape(n, t, c)
    return mixed @ params["projection"]["kernel"] + params["projection"]["bias"]


def test_attention_equals_numpy_under_jit_and_vmap(random_variables):
    attention, blocked = WindowAttention(heads=3), shift_mask(8, 8, 4, (2, 2), circular=False)
    rng = np.random.default_rng(0)
    windows = rng.normal(size=(2 * len(blocked), 16, 12)).astype(np.float32)
    params = random_variables(attention, windows)["params"]

    def apply(x):
        return attention.apply({"params": params}, x, blocked)

    expected = numpy_attention(params, windows.astype(np.float64), blocked, heads=3)
    tolerance = 1e-5 * np.abs(expected).max()
    np.testing.assert_allclose(jax.jit(apply)(windows), expected, atol=tolerance)
    one_by_one = jax.vmap(apply)(windows.reshape(2, len(blocked), 16, 12))
    np.testing.assert_allclose(one_by_one.reshape(expected.shape), expected, atol=tolerance)
