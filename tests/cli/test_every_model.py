"""Every preset and every shipped weight describes scans; one of each kind goes through all that takes weights."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.models.backbone_config import CircularConfig, SglprConfig
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.sim.dataset import simulate

from .conftest import SENSOR, Ended, assert_one_line_error, run_command

pytestmark = pytest.mark.slow
SHIPPED = "shipped "
MODELS = (*sglpr_jax.MODELS, *(SHIPPED + name for name in sglpr_jax.shipped_weights()))
SMALL = "small sglpr"
KINDS = ("tiny", SMALL, "shipped circular")
"""A square image of points, a polar one of densities, and weights without a segmentation head."""
SCANS = 24
"""Few, and yet so many that the drive comes back to a place."""
FEW = 3
"""The paper's network takes a second for each."""
STEM = CircularConfig(fine=(3,), widths=(4, 6), strides=(2, 1), means=(1, 2))
SMALL_SGLPR = dataclasses.replace(
    sglpr_jax.model_preset("sglpr"),
    polar=(16, 32),
    backbone=SglprConfig(stem=STEM, embed_dim=8, depths=(1, 1), heads=(1, 2)),
    head=HeadConfig(tap="tokens", channels=(8,), kernels=(3,), strides=(1,), means=(1,), clusters=4),
    detail=4,
)


@pytest.fixture(scope="module")
def towns(tmp_path_factory) -> dict[int, Path]:
    """Recordings of fewer scans than other tests have."""
    root = tmp_path_factory.mktemp("data")
    return {n: simulate(root / str(n), routes=("08",), scans=n, sensor=SENSOR).root for n in (FEW, SCANS)}


@pytest.fixture(scope="module")
def weights_of(random_params, tmp_path_factory) -> Callable[[str], str]:
    """The name of shipped weights, or a folder with random weights of a preset."""

    def find(name: str) -> str:
        if name.startswith(SHIPPED):
            return name.removeprefix(SHIPPED)
        params = random_params(SMALL_SGLPR if name == SMALL else sglpr_jax.model_preset(name))
        return str(sglpr_jax.save(params, tmp_path_factory.mktemp("weights") / name))

    return find


def well(name: str, *arguments: object) -> Ended:
    """Run a command; it must end well."""
    ended = run_command(name, *arguments)
    assert ended.status == 0, ended.error
    return ended


@pytest.mark.parametrize("model", MODELS)
def test_embed(weights_of, towns, model, tmp_path):
    options = ("--weights", weights_of(model), "--data", towns[FEW], "--seq", "08", "--batch", FEW)
    well("embed", *options, "--out", tmp_path / "08.npz")
    found = sglpr_jax.DescriptorFile.load(tmp_path / "08.npz").descriptors
    assert found.shape == (FEW, 256)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.linalg.norm(found[0] - found[-1]) > 1e-4


@pytest.mark.parametrize("model", KINDS)
def test_the_page_of_evaluate_and_segment(weights_of, towns, model, tmp_path):
    weights = weights_of(model)
    options = ("--weights", weights, "--data", towns[SCANS], "--seq", "08")
    segments = sglpr_jax.load(weights).config.segments
    assert segments == (not model.startswith(SHIPPED))

    well("embed", *options, "--out", tmp_path / "08.npz")
    well("evaluate", tmp_path / "08.npz", *options, "--out", tmp_path / "page")
    page = (tmp_path / "page" / "report.html").read_text()
    assert "feature heat maps of frame" in page
    assert ("semantic map of frame" in page) == segments

    maps = tmp_path / "maps"
    if segments:
        well("segment", *options, "--out", maps)
        assert 0 <= json.loads((maps / "segmentation.json").read_text())["mean_iou"] <= 1
    else:
        ended = run_command("segment", *options, "--out", maps)
        assert_one_line_error(ended, "expected weights with a segmentation head")
