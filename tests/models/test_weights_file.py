"""Weights on disk come back bit by bit, and everything that is not whole or does not fit is one clear error."""

import dataclasses
import json

import chex
import jax
import numpy as np
import pytest
import safetensors.numpy

from sglpr_jax.models import weights_file
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import hash_of, weights_hash
from sglpr_jax.models.weights_file import CONFIG_FILE, WEIGHTS_FILE, load, save


@pytest.fixture(scope="module")
def params(random_params) -> Params:
    return jax.tree.map(np.asarray, random_params(model_preset("tiny")))


def test_weights_and_configuration_come_back_bit_by_bit(params, tmp_path):
    folder = save(params, tmp_path / "new" / "weights")
    found = load(folder)
    chex.assert_trees_all_equal(found, params)
    chex.assert_trees_all_equal(load(str(folder.parent)), params)  # the folder of a training run
    assert found.config == params.config
    assert weights_hash(found) == weights_hash(params)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["weights"]
    assert sorted(path.name for path in folder.iterdir()) == [CONFIG_FILE, WEIGHTS_FILE]


def test_a_full_disk_is_an_error_that_names_the_folder_and_leaves_what_was_there(params, tmp_path, small_files):
    folder = save(params, tmp_path / "weights")
    with small_files(10_000), pytest.raises(OSError, match=rf"{folder}: cannot be written: File too large"):
        save(jax.tree.map(np.zeros_like, params), folder)
    assert weights_hash(load(folder)) == weights_hash(params)
    assert [path.name for path in tmp_path.iterdir()] == ["weights"]


def test_arrays_that_are_not_contiguous_come_back_as_they_are(params, tmp_path):
    """Imported PyTorch weights are transposed views."""
    kernel = params.weights["segmentation_head"]["kernel"]
    strided = {**params.weights, "segmentation_head": {"kernel": np.asfortranarray(kernel)}}
    chex.assert_trees_all_equal(load(save(Params(strided, params.config), tmp_path / "weights")), params)


def test_a_folder_with_other_files_is_not_replaced(params, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(FileExistsError, match=r"only config.json, model.safetensors .* found checkpoints"):
        save(params, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoints"]


@pytest.mark.parametrize("name", [CONFIG_FILE, WEIGHTS_FILE])
def test_a_missing_file_is_named(params, tmp_path, name):
    folder = save(params, tmp_path / "weights")
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=rf"weights: expected a folder with .*, {name} is missing"):
        load(folder)


@pytest.mark.parametrize("damage", [lambda data: data[:-100], lambda data: b""])
def test_damaged_weights_are_named(params, tmp_path, damage):
    folder = save(params, tmp_path / "weights")
    (folder / WEIGHTS_FILE).write_bytes(damage((folder / WEIGHTS_FILE).read_bytes()))
    with pytest.raises(ValueError, match=rf"{WEIGHTS_FILE}: expected a whole safetensors file, found a damaged one"):
        load(folder)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b'{"grid": ', "expected JSON"),
        (b'{"image": "points", "image": "density"}', "expected JSON, .*'image' appears twice"),
        (b'{"grid": []}', "expected the fields of a ModelConfig .*, found no 'backbone'"),
    ],
)
def test_a_damaged_configuration_is_named(params, tmp_path, text, expected):
    folder = save(params, tmp_path / "weights")
    (folder / CONFIG_FILE).write_bytes(text)
    with pytest.raises(ValueError, match=rf"{CONFIG_FILE}: .*{expected}"):
        load(folder)


def test_the_weights_of_another_preset_are_refused(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    (folder / CONFIG_FILE).write_text(json.dumps(dataclasses.asdict(model_preset("circular"))))
    with pytest.raises(ValueError, match=rf"{WEIGHTS_FILE}: expected \S+ as "):
        load(folder)


def test_a_digit_that_was_changed_in_the_configuration_is_noticed(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    other = dataclasses.asdict(dataclasses.replace(params.config, blind_m=1.0))  # of the same weights
    (folder / CONFIG_FILE).write_text(json.dumps(other))
    with pytest.raises(ValueError, match=rf"{WEIGHTS_FILE}: expected the {CONFIG_FILE} that it was saved with"):
        load(folder)


def test_a_weight_too_many_or_too_few_is_named(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    safetensors.numpy.save_file({**flat, "extra": np.zeros(3, np.float32)}, folder / WEIGHTS_FILE)
    with pytest.raises(ValueError, match=r"expected extra as no array, found float32 \(3,\)"):
        load(folder)
    kernel = flat.pop("segmentation_head/kernel")
    safetensors.numpy.save_file(flat, folder / WEIGHTS_FILE)
    with pytest.raises(
        ValueError, match=rf"segmentation_head/kernel as float32 \({kernel.shape[0]}, 20\), found no array"
    ):
        load(folder)


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


@pytest.mark.parametrize("dtype", [np.int32, np.float64])
def test_weights_of_another_type_are_refused_on_load_and_on_export(params, tmp_path, dtype):
    folder = save(params, tmp_path / "weights")
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    other = flat["segmentation_head/kernel"].astype(dtype)
    safetensors.numpy.save_file({**flat, "segmentation_head/kernel": other}, folder / WEIGHTS_FILE)
    with pytest.raises(ValueError, match=rf"{WEIGHTS_FILE}: expected segmentation_head/kernel as float32 .*, found "):
        load(folder)
    weights = {**params.weights, "segmentation_head": {"kernel": other}}
    with pytest.raises(ValueError, match=r"new: expected segmentation_head/kernel as float32 .*, found "):
        save(Params(weights, params.config), tmp_path / "new")


def test_one_flipped_bit_of_the_weights_is_found(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    content = bytearray((folder / WEIGHTS_FILE).read_bytes())
    content[-1000] ^= 1
    (folder / WEIGHTS_FILE).write_bytes(content)
    with pytest.raises(
        ValueError, match=rf"{WEIGHTS_FILE}: expected weights with the SHA-256 of the header, .*, found "
    ):
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
