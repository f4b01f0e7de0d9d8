import ast
import dataclasses
import re
import shlex
from pathlib import Path

import pytest

import sglpr_jax
from sglpr_jax.cli.train import parse
from sglpr_jax.models.config import MODELS
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.presets import load_preset, preset_names

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "configs").glob("*.py"))


def test_every_file_of_configs_is_a_preset():
    assert set(preset_names()) == {path.stem for path in CONFIGS}
    assert set(preset_names()) == set(MODELS) and len(MODELS) == 5


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_preset_loads_and_says_what_to_expect_and_how_to_run_it(path):
    assert isinstance(load_preset(path.stem), TrainConfig)
    said = ast.get_docstring(ast.parse(path.read_text())) or ""
    command = re.search(r"^Command: (bin/.+)$", said, re.MULTILINE)
    assert command and re.search("Expect|Reproduces", said)
    assert command[1].endswith(f"--preset {path.stem}")


def test_the_paper_presets_differ_in_the_model_alone():
    paper, other = load_preset("paper"), load_preset("paper-112")
    assert other.model.grid.resolution_m == paper.model.grid.resolution_m * 2
    assert dataclasses.replace(other, model=paper.model) == paper


def test_the_flags_of_the_guide_train_the_semantic_map_of_the_shipped_network():
    guide = (CONFIGS[0].parents[1] / "docs/guides/semantics.md").read_text().replace("\\\n", " ")
    command = next(line for line in guide.splitlines() if "--weights sglpr" in line)
    config = parse(shlex.split(command)[1:]).config
    assert config.model == sglpr_jax.load("sglpr").config
    assert config.loss.segmentation_alone and not load_preset("sglpr").loss.segmentation_alone


@pytest.mark.parametrize("name", ["smal", "nowhere/mine.py"])
def test_an_unknown_preset_lists_those_that_exist(name):
    with pytest.raises(ValueError, match=rf"no preset '{name}'.*paper-112, sglpr, tiny"):
        load_preset(name)


def test_a_file_without_a_config_is_named(tmp_path):
    (tmp_path / "mine.py").write_text("CONFIG = {'steps': 3}\n")
    with pytest.raises(ValueError, match=r"mine\.py: expected CONFIG, a TrainConfig, found dict"):
        load_preset(str(tmp_path / "mine.py"))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("CONFIG = TrainConfig(stepz=3)", "TypeError: .*stepz"),
        ("CONFIG = TrainConfig(", "SyntaxError: "),
        ("CONFIG = TrainConfig(steps=0)", r"ValueError: TrainConfig\.steps: expected a number from 1"),
        ("CONFIG = TrainConfig(model=ModelConfig(blind_m=float('nan')))", r"ModelConfig\.blind_m: expected a finite"),
    ],
)
def test_a_file_that_fails_is_named_with_what_it_raises(text, found, tmp_path):
    imports = "from sglpr_jax.models.config import ModelConfig\nfrom sglpr_jax.training.config import TrainConfig\n"
    (tmp_path / "mine.py").write_text(f"{imports}{text}\n")
    with pytest.raises(ValueError, match=rf"mine\.py: expected a preset, found one that fails: .*{found}"):
        load_preset(str(tmp_path / "mine.py"))
