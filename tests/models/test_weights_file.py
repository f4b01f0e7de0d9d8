"""Weights on disk come back bit by bit, and everything that is not whole or does not fit is one clear error."""

import dataclasses
import json
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
import safetensors.numpy

from sglpr_jax.data.formats.tensors import hash_of
from sglpr_jax.models import weights_file
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.weights import Params, weights_hash
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


def change_config(folder: Path, **changes) -> None:
    values = json.loads((folder / CONFIG_FILE).read_text())
    (folder / CONFIG_FILE).write_text(json.dumps(values | changes))


def change_weights(folder: Path, **changes) -> None:
    """Writes other arrays, or none, under their names."""
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE) | changes
    safetensors.numpy.save_file({name: leaf for name, leaf in flat.items() if leaf is not None}, folder / WEIGHTS_FILE)


def flip_bit(folder: Path) -> None:
    content = bytearray((folder / WEIGHTS_FILE).read_bytes())
    content[-1000] ^= 1
    (folder / WEIGHTS_FILE).write_bytes(content)


KERNEL = "segmentation_head/kernel"
BROKEN = np.full((8, 20), np.nan, np.float32)
WIDE = np.zeros((8, 20), np.float64)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda folder: (folder / CONFIG_FILE).unlink(),
            f"weights: expected a folder with .*, {CONFIG_FILE} is missing",
        ),
        (lambda folder: (folder / WEIGHTS_FILE).write_bytes(b""), f"{WEIGHTS_FILE}: expected a whole safetensors file"),
        (lambda folder: (folder / CONFIG_FILE).write_text('{"grid": '), f"{CONFIG_FILE}: .*expected JSON"),
        (lambda folder: (folder / CONFIG_FILE).write_text("{}"), f"{CONFIG_FILE}: .*found no 'backbone'"),
        (lambda folder: change_config(folder, blind_m=1.0), f"{WEIGHTS_FILE}: expected the {CONFIG_FILE} that it was"),
        (lambda folder: change_config(folder, detail=3), rf"{WEIGHTS_FILE}: expected \S+ as float32"),
        (
            lambda folder: change_weights(folder, extra=np.zeros(3, np.float32)),
            r"expected extra as no array, found float32 \(3,\)",
        ),
        (lambda folder: change_weights(folder, **{KERNEL: None}), rf"{KERNEL} as float32 \(8, 20\), found no array"),
        (lambda folder: change_weights(folder, **{KERNEL: BROKEN}), f"found 160 of 160 not finite in {KERNEL}"),
        (lambda folder: change_weights(folder, **{KERNEL: WIDE}), f"expected {KERNEL} as float32 .*, found float64"),
        (flip_bit, f"{WEIGHTS_FILE}: expected weights with the SHA-256 of the header"),
    ],
)
def test_what_is_not_whole_or_does_not_fit_is_named(params, tmp_path, damage, message):
    folder = save(params, tmp_path / "weights")
    damage(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load(folder)


@pytest.mark.parametrize(("kernel", "message"), [(BROKEN, "expected finite weights, found 160"), (WIDE, "as float32")])
def test_weights_that_could_not_be_loaded_are_not_saved(params, tmp_path, kernel, message):
    weights = {**params.weights, "segmentation_head": {"kernel": kernel}}
    with pytest.raises(ValueError, match=f"new: expected .*{message.removeprefix('expected ')}"):
        save(Params(weights, params.config), tmp_path / "new")
    assert not list(tmp_path.iterdir())


def test_a_configuration_without_fields_that_were_added_later_is_that_of_its_weights(params, tmp_path):
    folder = save(params, tmp_path / "weights")
    older = dataclasses.asdict(params.config)
    del older["head"]["means"]
    flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    header = {"sha256": hash_of(flat), "config_sha256": weights_file._config_hash(older)}
    safetensors.numpy.save_file(flat, folder / WEIGHTS_FILE, header)
    (folder / CONFIG_FILE).write_text(json.dumps(older))
    assert load(folder).config == params.config
    (folder / CONFIG_FILE).write_text(json.dumps({**older, "blind_m": 1.0}))
    with pytest.raises(ValueError, match="found a changed one"):
        load(folder)
