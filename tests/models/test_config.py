"""A configuration survives JSON, and every value of a wrong type or name is one clear error."""

import dataclasses
import functools
import json
from typing import Any

import pytest

from sglpr_jax.models.config import MODELS, ModelConfig, config_from_dict, model_preset


def values_of(config: ModelConfig) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(config)))


@pytest.mark.parametrize("preset", MODELS)
def test_every_preset_s_configuration_survives_json(preset):
    config = model_preset(preset)
    found = config_from_dict(values_of(config), source="here")
    assert found == config and hash(found) == hash(config)


@pytest.mark.parametrize("path", ["image", "backbone.stem.average"])
def test_a_missing_field_is_an_error_and_no_default(path):
    """Weights of density images without `image` would be fed point counts."""
    values = values_of(model_preset("sglpr-small"))
    *way, name = path.split(".")
    del functools.reduce(lambda place, step: place[step], way, values)[name]
    with pytest.raises(ValueError, match=rf"^here: .*expected the fields of a \w+ \(.*\), found no '{name}'$"):
        config_from_dict(values, source="here")


def test_files_of_earlier_versions_are_read():
    values = values_of(model_preset("sglpr"))
    values["backbone"]["stem"]["kind"] = "rings"
    assert config_from_dict(values, source="here") == model_preset("sglpr")
    values = values_of(model_preset("paper"))
    values["backbone"]["stem"] = []
    assert config_from_dict(values, source="here") == model_preset("paper")
    values["backbone"]["stem"] = [4, 8]  # a network that can no longer be built
    with pytest.raises(ValueError, match="found 'stem'"):
        config_from_dict(values, source="here")


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("categories", 7, "categories: expected one of 0, 6, 15, 20, 25, 34, found 7"),
        ("polar", [64, "256"], "polar: expected a value of type int, found '256'"),
        ("backbone", None, "expected the fields of a SwinConfig or SglprConfig, found None"),
        ("backbone.kind", "vgg", "backbone: expected a kind, swin or sglpr, found 'vgg'"),
        ("blind_m", 30.0, "blind_m: expected less than the 25.6 m that the image reaches, found 30.0"),
        ("grid.resolution_m", float("inf"), "grid.resolution_m: expected a finite number, found inf"),
        ("grid.height", 127, "grid: height: expected an even number of cells, found 127"),
        ("head.clusters", 0, "head.clusters: expected a number from 1 up to 1048576, found 0"),
        ("backbone.stem.widths", [], "backbone.stem: widths: expected at least one block, found ()"),
        ("depths", [2, 2], "here: expected the fields of a ModelConfig (grid, "),
    ],
)
def test_a_wrong_value_is_one_line_with_file_field_expected_and_found(path, value, message):
    values = values_of(model_preset("sglpr-small"))
    *way, name = path.split(".")
    functools.reduce(lambda place, step: place[step], way, values)[name] = value
    with pytest.raises(ValueError) as error:
        config_from_dict(values, source="here")
    assert str(error.value).startswith("here: ") and "\n" not in str(error.value)
    assert message in str(error.value)
    assert path != "depths" or "found 'depths'" in str(error.value)
