"""Weights on disk come back bit by bit, and everything that is not whole or does not fit is one clear error."""

import dataclasses
import json

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

import sglpr_jax
from sglpr_jax.models import weights_file
from sglpr_jax.models.config import CircularConfig, HeadConfig, model_preset
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import (
    as_tree,
    by_name,
    describing,
    for_places,
    graft,
    hash_of,
    weight_shapes,
    weights_hash,
)
from sglpr_jax.models.weights_file import CONFIG_FILE, WEIGHTS_FILE, load, save


@pytest.fixture(scope="module")
def params(random_params) -> Params:
    return jax.tree.map(np.asarray, random_params(model_preset("tiny")))


def test_weights_and_configuration_come_back_bit_by_bit(params, tmp_path):
    folder = save(params, tmp_path / "new" / "weights")
    found = load(folder)
    chex.assert_trees_all_equal(found, params)
    assert found.config == params.config
    assert weights_hash(found) == weights_hash(params)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["weights"]
    assert sorted(path.name for path in folder.iterdir()) == [CONFIG_FILE, WEIGHTS_FILE]


def test_weights_with_and_without_a_segmentation_head_are_grafted_onto_each_other(params):
    kept = {name: values for name, values in params.weights.items() if name != "segmentation_head"}
    given = Params(kept, dataclasses.replace(params.config, categories=0))
    fresh = jax.tree.map(np.zeros_like, params)
    found = graft(given, fresh)
    assert found.config == params.config
    chex.assert_trees_all_equal({k: v for k, v in found.weights.items() if k != "segmentation_head"}, kept)
    chex.assert_trees_all_equal(found.weights["segmentation_head"], fresh.weights["segmentation_head"])
    chex.assert_trees_all_equal(graft(params, given).weights, kept)
    with pytest.raises(ValueError, match=r"segmentation_head/kernel has shape .*, expected no such weight"):
        graft(params, dataclasses.replace(fresh, weights=kept))


def with_fine_blocks(*channels):
    rings = CircularConfig(widths=(4, 6), strides=(2, 1), means=(1, 2), fine=channels)
    head = HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=(), clusters=4)
    return dataclasses.replace(model_preset("tiny"), field="circle", polar=(16, 32), backbone=rings, head=head)


@pytest.mark.slow
def test_a_network_grown_by_fine_blocks_begins_as_the_smaller_one():
    small = sglpr_jax.init(jax.random.key(0), config=with_fine_blocks(5))
    grown = graft(small, sglpr_jax.init(jax.random.key(1), config=with_fine_blocks(5, 6)))
    bev = jnp.asarray(np.random.default_rng(0).poisson(0.7, (2, 32, 32)), jnp.float32)
    describe, segment = jax.jit(sglpr_jax.describe), jax.jit(sglpr_jax.segment)
    np.testing.assert_allclose(describe(grown, bev), describe(small, bev), atol=1e-6)
    np.testing.assert_allclose(segment(grown, bev), segment(small, bev), atol=1e-5)
    expected = r"decoder/block_1/convolution/kernel has shape \(3, 3, 10, 4\), expected \(3, 3, 5, 4\)"
    with pytest.raises(ValueError, match=expected):
        graft(small, sglpr_jax.init(jax.random.key(1), config=with_fine_blocks()))


def test_a_segmentation_head_that_sees_more_channels_begins_with_those_it_had(params):
    fresh = sglpr_jax.init(jax.random.key(1), config=dataclasses.replace(params.config, detail=40))
    kernel = graft(params, fresh).weights["segmentation_head"]["kernel"]
    was = params.weights["segmentation_head"]["kernel"]
    np.testing.assert_array_equal(kernel, np.pad(was, [(0, 40 - len(was)), (0, 0)]))
    narrower = sglpr_jax.init(jax.random.key(1), config=dataclasses.replace(params.config, detail=len(was) - 1))
    with pytest.raises(ValueError, match="segmentation_head/kernel has shape"):
        graft(params, narrower)


def test_a_full_disk_is_an_error_that_names_the_folder_and_leaves_what_was_there(params, tmp_path, small_files):
    folder = save(params, tmp_path / "weights")
    with small_files(10_000), pytest.raises(OSError, match=rf"{folder}: cannot be written: File too large"):
        save(jax.tree.map(np.zeros_like, params), folder)
    assert weights_hash(load(folder)) == weights_hash(params)
    assert [path.name for path in tmp_path.iterdir()] == ["weights"]


@pytest.mark.parametrize("changes", [{"range_channel": True, "detail": 8}, {"detail": 4}])
def test_weights_of_any_configuration_come_back(random_params, changes, tmp_path):
    params = random_params(dataclasses.replace(model_preset("tiny"), **changes))
    chex.assert_trees_all_equal(load(save(params, tmp_path / "weights")), jax.tree.map(np.asarray, params))


def test_arrays_that_are_not_contiguous_come_back_as_they_are(params, tmp_path):
    """Imported PyTorch weights are transposed views."""
    kernel = params.weights["segmentation_head"]["kernel"]
    strided = {**params.weights, "segmentation_head": {"kernel": np.asfortranarray(kernel)}}
    chex.assert_trees_all_equal(load(save(Params(strided, params.config), tmp_path / "weights")), params)


def test_saving_again_replaces_the_folder(params, tmp_path):
    save(params, tmp_path / "weights")
    doubled = jax.tree.map(lambda leaf: 2 * leaf, params)
    save(doubled, tmp_path / "weights")
    chex.assert_trees_all_equal(load(tmp_path / "weights"), doubled)
    assert [path.name for path in tmp_path.iterdir()] == ["weights"]


def test_a_folder_with_other_files_is_not_replaced(params, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(FileExistsError, match=r"only config.json, model.safetensors .* found checkpoints"):
        save(params, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoints"]


def test_a_training_run_s_folder_is_its_weights(params, tmp_path):
    save(params, tmp_path / "run" / "weights")
    chex.assert_trees_all_equal(load(tmp_path / "run"), params)
    chex.assert_trees_all_equal(load(str(tmp_path / "run")), params)


@pytest.mark.parametrize("name", [CONFIG_FILE, WEIGHTS_FILE])
def test_a_missing_file_is_named(params, tmp_path, name):
    folder = save(params, tmp_path / "weights")
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=rf"weights: expected a folder with .*, {name} is missing"):
        load(folder)


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="none: expected a folder with"):
        load(tmp_path / "none")


@pytest.mark.parametrize("damage", [lambda data: data[:-100], lambda data: b"", lambda data: b"no tensors" * 9])
def test_damaged_weights_are_named(params, tmp_path, damage):
    folder = save(params, tmp_path / "weights")
    (folder / WEIGHTS_FILE).write_bytes(damage((folder / WEIGHTS_FILE).read_bytes()))
    with pytest.raises(ValueError, match=rf"{WEIGHTS_FILE}: expected a whole safetensors file, found a damaged one"):
        load(folder)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b'{"grid": ', "expected JSON"),
        (b"\xff\xfe\x00", "expected JSON"),
        (b"[1, 2]", "expected the fields of a ModelConfig"),
        (b"[" * 100_000, "expected JSON"),
        (b'{"image": "points", "image": "density"}', "expected JSON, .*'image' appears twice"),
        (b'{"grid": []}', "expected the fields of a ModelConfig .*, found no 'backbone'"),
        (lambda values: values["grid"].update(colour=3), "grid: expected the fields of a Grid .*, found 'colour'"),
        (lambda values: values["grid"].update(height=33), "grid: height: expected an even number of cells, found 33"),
        (lambda values: values.update(blind_m=float("nan")), "blind_m: expected a finite number, found nan"),
        (lambda values: values.update(image="Density"), "image: expected one of 'points', 'density', found 'Density'"),
    ],
)
def test_a_damaged_configuration_is_named(params, tmp_path, text, expected):
    folder = save(params, tmp_path / "weights")
    if callable(text):
        values = json.loads((folder / CONFIG_FILE).read_text())
        text(values)
        text = json.dumps(values).encode()
    (folder / CONFIG_FILE).write_bytes(text)
    with pytest.raises(ValueError, match=rf"{CONFIG_FILE}: .*{expected}"):
        load(folder)


def test_the_weights_of_another_preset_are_refused(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    (folder / CONFIG_FILE).write_text(json.dumps(dataclasses.asdict(model_preset("circular"))))
    with pytest.raises(ValueError, match=rf"{WEIGHTS_FILE}: expected the weights of its configuration, \S+ of shape"):
        load(folder)


def test_what_was_checked_when_it_was_written_is_not_checked_again(params, tmp_path, monkeypatch):
    folder = save(params, tmp_path / "weights")
    asked = []
    monkeypatch.setattr(weights_file, "weight_shapes", lambda config: asked.append(config) or weight_shapes(config))
    chex.assert_trees_all_equal(load(folder), params)
    assert asked == []
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    safetensors.numpy.save_file(flat, folder / WEIGHTS_FILE)  # an earlier version wrote no checksums
    assert load(folder).config == params.config and asked == [params.config]


def test_a_digit_that_was_changed_in_the_configuration_is_noticed(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    other = dataclasses.asdict(dataclasses.replace(params.config, blind_m=1.0))  # of the same weights
    (folder / CONFIG_FILE).write_text(json.dumps(other))
    with pytest.raises(ValueError, match=rf"{WEIGHTS_FILE}: expected the {CONFIG_FILE} that it was saved with"):
        load(folder)


def test_a_configuration_without_fields_that_were_added_later_is_that_of_its_weights(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    older = dataclasses.asdict(params.config)
    del older["head"]["means"]
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    header = {"sha256": hash_of(flat), "config_sha256": weights_file._hash_of(older)}
    safetensors.numpy.save_file(flat, folder / WEIGHTS_FILE, header)
    (folder / CONFIG_FILE).write_text(json.dumps(older))
    assert load(folder).config == params.config
    (folder / CONFIG_FILE).write_text(json.dumps({**older, "blind_m": 1.0}))
    with pytest.raises(ValueError, match="found a changed one"):
        load(folder)


def test_equal_weights_are_equal_files(params, tmp_path):
    files = {(save(params, tmp_path / f"{i}") / WEIGHTS_FILE).read_bytes() for i in range(8)}
    assert len(files) == 1


def test_a_weight_too_many_or_too_few_is_named(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    safetensors.numpy.save_file({**flat, "extra": np.zeros(3, np.float32)}, folder / WEIGHTS_FILE)
    with pytest.raises(ValueError, match=r"extra of shape none \(unknown weight\), found \(3,\)"):
        load(folder)
    kernel = flat.pop("segmentation_head/kernel")
    safetensors.numpy.save_file(flat, folder / WEIGHTS_FILE)
    with pytest.raises(ValueError, match=rf"segmentation_head/kernel of shape \({kernel.shape[0]}, 20\), found none"):
        load(folder)


def test_the_hash_changes_with_one_value_and_one_name(params):
    def changed(kernel, name="kernel"):
        head = params.weights["place_head"]
        layer = {"bias": head["convolution_0"]["bias"], name: kernel}
        return weights_hash(Params(params.weights | {"place_head": head | {"convolution_0": layer}}, params.config))

    kernel = params.weights["place_head"]["convolution_0"]["kernel"]
    nudged = kernel.copy()
    nudged.flat[0] = np.nextafter(nudged.flat[0], np.float32(9))
    hashes = [weights_hash(params), changed(nudged), changed(kernel, "other"), changed(kernel.reshape(4, -1))]
    assert len(set(hashes)) == 4
    assert changed(jnp.asarray(kernel)) == weights_hash(params)
    assert len(hashes[0]) == 64


def test_the_hash_is_that_of_what_describes(params):
    other_map = jax.tree.map(lambda x: x + 1, params.weights["segmentation_head"])
    other = dataclasses.replace(params, weights=params.weights | {"segmentation_head": other_map})
    assert weights_hash(other) == weights_hash(for_places(params)) == weights_hash(params)


@pytest.mark.slow
@pytest.mark.parametrize("tap", ["tokens", "pixels"])
@pytest.mark.parametrize("name", ["paper", "circular", "sglpr"])
def test_what_describes_is_what_a_model_without_a_segmentation_head_has(name, tap):
    config = model_preset(name)
    config = dataclasses.replace(config, head=dataclasses.replace(config.head, tap=tap))
    whole = Params(as_tree(dict(weight_shapes(config))), config)
    assert set(by_name(describing(whole))) == set(weight_shapes(dataclasses.replace(config, categories=0)))


def test_weights_that_are_not_finite_are_refused_on_load_and_on_export(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    for value in (np.nan, np.inf):
        broken = flat["segmentation_head/kernel"].copy()
        broken[0, 1] = value
        safetensors.numpy.save_file({**flat, "segmentation_head/kernel": broken}, folder / WEIGHTS_FILE)
        found = rf"found 1 of {broken.size} not finite in segmentation_head/kernel"
        with pytest.raises(ValueError, match=rf"{WEIGHTS_FILE}: expected finite weights, {found}"):
            load(folder)
        weights = {**params.weights, "segmentation_head": {"kernel": broken}}
        with pytest.raises(ValueError, match=rf"new: expected finite weights, {found}"):
            save(Params(weights, params.config), tmp_path / "new")
        assert [path.name for path in tmp_path.iterdir()] == ["weights"]


@pytest.mark.parametrize("dtype", [np.int32, np.bool_, np.float64, np.uint8])
def test_weights_of_another_type_are_refused_on_load_and_on_export(params, tmp_path, dtype):
    folder = save(params, tmp_path / "weights")
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    other = flat["segmentation_head/kernel"].astype(dtype)
    safetensors.numpy.save_file({**flat, "segmentation_head/kernel": other}, folder / WEIGHTS_FILE)
    with pytest.raises(
        ValueError, match=rf"{WEIGHTS_FILE}: expected segmentation_head/kernel as F32 or F16 with values, found "
    ):
        load(folder)
    weights = {**params.weights, "segmentation_head": {"kernel": other}}
    with pytest.raises(ValueError, match="new: expected segmentation_head/kernel as float32, found "):
        save(Params(weights, params.config), tmp_path / "new")


def test_weights_of_other_names_or_shapes_are_not_written(params, tmp_path):
    kernel = params.weights["segmentation_head"]["kernel"]
    for head in ({}, {"kernel": kernel, "bias": kernel}, {"kernel": kernel[:-1]}):
        with pytest.raises(
            ValueError, match=r"new: expected the weights of its configuration, segmentation_head/\w+ of shape"
        ):
            save(Params({**params.weights, "segmentation_head": head}, params.config), tmp_path / "new")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("half", [False, True])
def test_one_flipped_bit_of_the_weights_is_found(params, tmp_path, half):
    folder = save(params, tmp_path / "weights", half=half)
    content = bytearray((folder / WEIGHTS_FILE).read_bytes())
    content[-1000] ^= 1
    (folder / WEIGHTS_FILE).write_bytes(content)
    with pytest.raises(
        ValueError, match=rf"{WEIGHTS_FILE}: expected weights with the SHA-256 of the header, .*, found "
    ):
        load(folder)
