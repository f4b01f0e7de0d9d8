"""Every preset and every shipped weight goes through every command that takes weights."""

import json
from pathlib import Path

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.sim import write_dataset

from .conftest import SENSOR, Ended

pytestmark = pytest.mark.slow
MODELS = (*sglpr_jax.MODELS, *sglpr_jax.shipped_weights())
SCANS = 24
"""Few, for the paper's network takes a second for each; so many come back to a place."""


@pytest.fixture(scope="module")
def town(tmp_path_factory) -> Path:
    """A recording of fewer scans than other tests have; it comes back to places."""
    return write_dataset(tmp_path_factory.mktemp("data") / "short", names=("08",), scans=SCANS, sensor=SENSOR)


@pytest.fixture(scope="module", params=MODELS)
def model(request, random_params, tmp_path_factory) -> str:
    """The name of shipped weights, or a folder with random weights of a preset."""
    name = request.param
    if name not in sglpr_jax.MODELS:
        return name
    params = random_params(sglpr_jax.model_preset(name))
    return str(sglpr_jax.save(params, tmp_path_factory.mktemp("weights") / name))


@pytest.fixture
def on_the_town(command, model, town):
    """Run a command with the weights on drive 08, its output going to a path; it must end well."""

    def run(name: str, *arguments: object, out: Path) -> Ended:
        options = ("--weights", model, "--data", town, "--seq", "08", "--out", out)
        ended = command(name, *arguments, *options)
        assert ended.status == 0, ended.error
        return ended

    return run


def test_embed_and_the_page_of_evaluate(on_the_town, model, tmp_path):
    on_the_town("embed", "--batch", 8, out=tmp_path / "08.npz")
    found = sglpr_jax.DescriptorFile.load(tmp_path / "08.npz").descriptors
    assert found.shape == (SCANS, 256)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.linalg.norm(found[0] - found[SCANS // 2]) > 1e-4
    on_the_town("evaluate", tmp_path / "08.npz", out=tmp_path / "page")
    page = (tmp_path / "page" / "report.html").read_text()
    assert "feature heat maps of frame" in page
    assert ("semantic map of frame" in page) == sglpr_jax.load(model).config.segments


def test_stress(on_the_town, tmp_path):
    on_the_town("stress", "--corruption", "rotation", "--batch", 8, out=tmp_path / "stress")
    rows = json.loads((tmp_path / "stress" / "results.json").read_text())
    assert [row["corruption"] for row in rows] == ["clean", "rotation"]


def test_segment_where_there_is_a_head(on_the_town, command, model, town, tmp_path):
    config = sglpr_jax.load(model).config
    if not config.segments:
        options = ("--weights", model, "--data", town, "--seq", "08", "--out", tmp_path / "maps")
        assert "expected weights with a segmentation head" in command("segment", *options).error
        return
    on_the_town("segment", out=tmp_path / "maps")
    assert 0 <= json.loads((tmp_path / "maps" / "segmentation.json").read_text())["mean_iou"] <= 1
