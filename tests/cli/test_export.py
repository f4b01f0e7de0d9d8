"""bin/export writes weights that describe places, which all commands accept by name."""

import dataclasses
from pathlib import Path

import chex
import jax
import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.models import shipped

load = sglpr_jax.DescriptorFile.load


@pytest.fixture(scope="module")
def weights(random_params, tmp_path_factory) -> Path:
    """Weights of a small model with a segmentation head."""
    tiny = sglpr_jax.model_preset("tiny")
    head = dataclasses.replace(tiny.head, channels=(16,), kernels=(4,), strides=(4,))
    grid = sglpr_jax.Grid(resolution_m=3.2, height=16, width=16)
    backbone = dataclasses.replace(tiny.backbone, depths=(1,), heads=(2,))
    config = dataclasses.replace(tiny, grid=grid, backbone=backbone, head=head)
    return sglpr_jax.save(random_params(config), tmp_path_factory.mktemp("runs") / "weights")


@pytest.fixture
def exported(command, weights, tmp_path, monkeypatch) -> Path:
    """These weights, exported under the name `sglpr-small` into a package folder of their own."""
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "package")
    folder = shipped.FOLDER / "sglpr-small"
    ended = command("export", "--weights", weights, "--out", folder, "--half")
    assert ended.status == 0, ended.error
    assert f"{folder}: 0." in ended.out and "MB of weights" in ended.out
    return folder


def test_exported_weights_embed_by_name_as_the_whole_ones_do(command, exported, weights, town, tmp_path):
    for name in ("sglpr-small", weights):
        options = ("--weights", name, "--data", town, "--seq", "08", "--out", tmp_path / f"{Path(name).name}.npz")
        ended = command("embed", *options)
        assert ended.status == 0, ended.error
    found, whole = (load(tmp_path / f"{name}.npz").descriptors for name in ("sglpr-small", "weights"))
    assert 0 < np.abs(found - whole).max() < 1e-2


def test_an_export_in_float32_with_the_head_is_unchanged(command, weights, tmp_path):
    ended = command("export", "--weights", weights, "--out", tmp_path / "out", "--keep-segmentation")
    assert ended.status == 0, ended.error
    for file in ("model.safetensors", "config.json"):
        assert (tmp_path / "out" / file).read_bytes() == (weights / file).read_bytes()


@pytest.mark.slow
def test_a_program_is_written_in_place_of_weights(command, weights, tmp_path):
    ended = command("export", "--weights", weights, "--out", tmp_path / "out", "--format", "stablehlo")
    assert ended.status == 0 and "MB of stablehlo" in ended.out, ended.error
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"describe.stablehlo", "config.json", "input.json"}


def test_average_is_the_mean_of_the_weights_with_and_without_the_head(command, weights, tmp_path):
    params = sglpr_jax.load(weights)
    doubled = dataclasses.replace(params, weights=jax.tree.map(lambda leaf: 2 * leaf, params.weights))
    other = sglpr_jax.save(doubled, tmp_path / "other")
    options = ("export", "--weights", weights, "--average", other, "--shares", "3", "1")
    for keep in ((), ("--keep-segmentation",)):
        out = tmp_path / f"out{len(keep)}"
        ended = command(*options, *keep, "--out", out)
        assert ended.status == 0, ended.error
        expected = params if keep else sglpr_jax.for_places(params)
        found = sglpr_jax.load(out)
        assert found.config == expected.config
        chex.assert_trees_all_close(found.weights, jax.tree.map(lambda leaf: 1.25 * leaf, expected.weights), rtol=1e-6)
