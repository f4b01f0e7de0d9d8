import ast
import re
import shlex
from pathlib import Path

import pytest

import sglpr_jax
from sglpr_jax.cli.runtime import parse_command
from sglpr_jax.cli.train import TrainCommand
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


def test_the_flags_of_the_guide_train_the_semantic_map_of_the_shipped_network():
    guide = (CONFIGS[0].parents[1] / "docs/guides/semantics.md").read_text().replace("\\\n", " ")
    command = next(line for line in guide.splitlines() if "--weights sglpr" in line)
    config = parse_command(TrainCommand, "train", shlex.split(command)[1:]).config
    assert config.model == sglpr_jax.load("sglpr").config
    assert config.loss.segmentation_alone and not load_preset("sglpr").loss.segmentation_alone


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("CONFIG = {'steps': 3}", "expected CONFIG, a TrainConfig, found dict"),
        ("CONFIG = TrainConfig(stepz=3)", "expected a preset, found one that fails: TypeError: .*stepz"),
        ("CONFIG = TrainConfig(", "expected a preset, found one that fails: SyntaxError: "),
        (None, "no preset '.*mine.py': expected a .py file or one of .*paper-112, sglpr, tiny"),
    ],
)
def test_a_wrong_preset_is_named(text, found, tmp_path):
    if text is not None:
        (tmp_path / "mine.py").write_text(f"from sglpr_jax.training.config import TrainConfig\n{text}\n")
    with pytest.raises(ValueError, match=found):
        load_preset(str(tmp_path / "mine.py"))
