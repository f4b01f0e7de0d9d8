from pathlib import Path

import pytest

from sglpr_jax.models.config import MODELS
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.presets import load_preset, preset_names

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "configs").glob("*.py"))


def test_every_file_of_configs_is_a_preset():
    assert set(preset_names()) == {path.stem for path in CONFIGS}
    assert set(preset_names()) == set(MODELS) and len(MODELS) == 5
    assert all(isinstance(load_preset(name), TrainConfig) for name in preset_names())


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("CONFIG = {'steps': 3}", "expected CONFIG, a TrainConfig, found dict"),
        ("CONFIG = TrainConfig(stepz=3)", "expected a preset, found one that fails: TypeError: .*stepz"),
        ("CONFIG = TrainConfig(", "expected a preset, found one that fails: SyntaxError: "),
        (None, "no preset '.*mine.py': expected a .py file or one of .*paper-112, sglpr, sglpr-small, tiny"),
    ],
)
def test_a_wrong_preset_is_named(text, found, tmp_path):
    if text is not None:
        (tmp_path / "mine.py").write_text(f"from sglpr_jax.training.config import TrainConfig\n{text}\n")
    with pytest.raises(ValueError, match=found):
        load_preset(str(tmp_path / "mine.py"))
