"""Golden numbers of the PyTorch reference, and what counts as equal to them."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import ModelConfig

FIXTURES = Path(__file__).resolve().parents[1] / "fixtures"
TOLERANCE = 1e-4


@pytest.fixture
def golden(request):
    """Reads a file of golden numbers: those in tests/fixtures, or the larger ones of the development data."""

    def read(name: str) -> dict[str, np.ndarray]:
        path = FIXTURES / f"{name}.npz"
        if not path.is_file():
            path = request.getfixturevalue("shared") / "fixtures" / f"{name}.npz"
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}

    return read


@pytest.fixture
def assert_parity():
    """Largest difference at most 1e-4 of the golden tensor's largest value; `pytest -s` prints the ratio."""

    def check(found: Any, golden: Any, name: str) -> None:
        found, golden = np.asarray(found, np.float64), np.asarray(golden, np.float64)
        assert found.shape == golden.shape, name
        ratio = np.abs(found - golden).max() / np.abs(golden).max()
        print(f"{name}: {ratio:.1e}")
        assert ratio <= TOLERANCE, f"{name}: off by {ratio:.1e} of its largest value"

    return check


@pytest.fixture
def model_config():
    """The model of a golden file: its own configuration in the words of ours."""

    def read(golden: dict[str, np.ndarray]) -> ModelConfig:
        values = json.loads(str(golden["config"]))
        return ModelConfig(
            grid=Grid(height=values["img_size"], width=values["img_size"]),
            backbone=SwinConfig(
                embed_dim=values["embed_dim"],
                depths=tuple(values["depths"]),
                heads=tuple(values["num_heads"]),
                window=values["window_size"],
                drop_path=values["drop_path_rate"],
            ),
            categories=values["num_classes"],
        )

    return read


@pytest.fixture(scope="session")
def random_variables():
    """Random weights of a module, biases included; made by numpy, for compiling a module's own `init` takes seconds."""

    def make(module, *inputs: Any):
        rng = np.random.default_rng(0)
        shapes = jax.eval_shape(module.init, jax.random.key(0), *inputs)
        return jax.tree.map(lambda leaf: rng.normal(scale=0.3, size=leaf.shape).astype(leaf.dtype), shapes)

    return make
