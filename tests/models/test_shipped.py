"""Weights by name, and that every set which ships with the package is whole, small, documented and works."""

import dataclasses
import re
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.models import shipped
from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import HeadConfig, model_preset
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe
from sglpr_jax.models.shipped import shipped_weights, weights_folder
from sglpr_jax.models.weights import for_places
from sglpr_jax.models.weights_file import CONFIG_FILE, WEIGHTS_FILE, load, save

CARD_FILE = "README.md"
FILES = [CARD_FILE, CONFIG_FILE, WEIGHTS_FILE]
LARGEST_BYTES = 15e6
CARD = {"Licence": "Apache-2.0", "Training data": "None.", "Command": "`none`", "Numbers": "Recall@1 0.0"}

HEAD = HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4)
SWIN = SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.1)
MODEL = dataclasses.replace(model_preset("tiny"), grid=Grid(3.2, 16, 16), backbone=SWIN, detail=8, head=HEAD)


def assert_fit_to_ship(folder: Path) -> None:
    """The files are there and small, the card says what it must, and an image has a descriptor of unit length."""
    assert sorted(path.name for path in folder.iterdir()) == FILES, folder
    for path in folder.iterdir():
        assert path.stat().st_size <= LARGEST_BYTES, f"{path} is larger than 15 MB"
    said = sections((folder / CARD_FILE).read_text())
    for title in CARD:
        assert said.get(title), f"{folder / CARD_FILE}: expected a section '## {title}' with text in it"
    assert "`" in said["Command"], f"{folder / CARD_FILE}: expected the command itself"
    assert re.search(r"\d", said["Numbers"]), f"{folder / CARD_FILE}: expected numbers"
    params = load(folder)
    grid = params.config.grid
    images = np.random.default_rng(0).poisson(0.3, (2, grid.height, grid.width)).astype(np.float32)
    descriptors = np.asarray(describe(params, jnp.asarray(images)))
    assert np.isfinite(descriptors).all()
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, rtol=1e-4)


def sections(card: str) -> dict[str, str]:
    """The text under each second-level heading."""
    parts = re.split(r"^## +(.+?) *$", card, flags=re.MULTILINE)
    return {title: text.strip() for title, text in zip(parts[1::2], parts[2::2], strict=True)}


@pytest.fixture(scope="module")
def params(random_params) -> Params:
    return random_params(MODEL)


@pytest.fixture
def placeholder(params, tmp_path, monkeypatch) -> Path:
    """A set of weights `placeholder`, which is all that ships."""
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "package")
    folder = save(for_places(params), shipped.FOLDER / "placeholder", half=True)
    (folder / CARD_FILE).write_text("# A card\n" + "".join(f"\n## {title}\n\n{text}\n" for title, text in CARD.items()))
    return folder


@pytest.mark.slow
def test_every_set_that_ships_is_fit_to():
    assert shipped_weights(), f"{shipped.FOLDER}: expected at least one set of weights"
    for name in shipped_weights():
        assert_fit_to_ship(shipped.FOLDER / name)


def test_a_name_means_the_shipped_weights_and_a_path_a_folder(placeholder, params, tmp_path, monkeypatch):
    assert shipped_weights() == ("placeholder",)
    monkeypatch.chdir(tmp_path)
    own = save(params, tmp_path / "placeholder")
    for name in ("placeholder", Path("placeholder")):
        assert weights_folder(name) == placeholder
        assert load(name).config.categories == 0
    for path in ("./placeholder", "placeholder/", str(own), own):
        assert load(path).config.categories == 20
    save(params, tmp_path / "other")
    chex.assert_trees_all_equal(load("other"), load(own))


def images_of(params: Params) -> jax.Array:
    grid = params.config.grid
    return jnp.asarray(np.random.default_rng(1).poisson(0.5, (6, grid.height, grid.width)), jnp.float32)


@pytest.mark.parametrize(("tap", "also_dropped"), [("pixels", set()), ("tokens", {"expand"})])
def test_what_the_segmentation_head_alone_reads_is_dropped(random_params, tap, also_dropped, tmp_path):
    whole = random_params(dataclasses.replace(MODEL, head=dataclasses.replace(HEAD, tap=tap)))
    places = for_places(whole)
    assert set(whole.weights) - set(places.weights) == {"segmentation_head", "narrow", "detail"} | also_dropped
    assert not places.config.segments
    images = images_of(whole)
    np.testing.assert_array_equal(describe(places, images), describe(whole, images))
    chex.assert_trees_all_equal(load(save(places, tmp_path / "weights")), jax.tree.map(np.asarray, places))
    assert for_places(places) is places
