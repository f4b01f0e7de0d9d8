"""A configuration survives JSON, and every value of a wrong type or name is one clear error."""

import dataclasses
import json
from typing import Any

import pytest

from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.config_dict import config_from_dict
from sglpr_jax.models.presets import MODELS, model_preset


def values_of(config: ModelConfig) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(config)))


@pytest.mark.parametrize("preset", MODELS)
def test_every_preset_s_configuration_survives_json(preset):
    config = model_preset(preset)
    found = config_from_dict(values_of(config), source="here")
    assert found == config and hash(found) == hash(config)


def test_fields_that_are_not_there_have_their_defaults():
    values = values_of(model_preset("rings"))
    del values["head"]["cbam_reduction"], values["compute"], values["backbone"]["average"]
    assert config_from_dict(values, source="here") == model_preset("rings")
    assert config_from_dict({}, source="here") == ModelConfig()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("detail", "32", "detail: expected a value of type int, found '32'"),
        ("detail", True, "detail: expected a value of type int, found True"),
        ("blind_m", None, "blind_m: expected a value of type float, found None"),
        ("range_channel", 1, "range_channel: expected a value of type bool, found 1"),
        ("categories", 7, "categories: expected one of 0, 6, 15, 20, 25, 34, found 7"),
        ("categories", 20.0, "categories: expected one of 0, 6, 15, 20, 25, 34, found 20.0"),
        ("compute", "float16", "compute: expected one of 'float32', 'bfloat16', found 'float16'"),
        ("polar", [64], "polar: expected a list of 2, found [64]"),
        ("polar", [64, "256"], "polar: expected a value of type int, found '256'"),
        ("polar", 64, "polar: expected a list, found 64"),
        ("grid.height", 128.0, "grid.height: expected a value of type int, found 128.0"),
        ("head.cbam", "yes", "head.cbam: expected a value of type bool, found 'yes'"),
        ("head.channels", 3, "head.channels: expected a list, found 3"),
        ("head", [], "head: expected the fields of a HeadConfig, found []"),
        ("backbone", None, "backbone: expected the fields of a SwinConfig, found None"),
        ("backbone.kind", "vgg", "backbone: expected a kind, swin or rings or sglpr, found 'vgg'"),
        ("backbone.kind", "swin", "backbone: expected the fields of a SwinConfig ("),
        ("backbone.widths", [[16]], "backbone.widths: expected a value of type int, found [16]"),
        ("depths", [2, 2], "here: expected the fields of a ModelConfig (grid, "),
    ],
)
def test_a_wrong_value_is_one_line_with_file_field_expected_and_found(path, value, message):
    values = values_of(model_preset("rings"))
    *way, name = path.split(".")
    place = values
    for step in way:
        place = place[step]
    place[name] = value
    with pytest.raises(ValueError) as error:
        config_from_dict(values, source="here")
    assert str(error.value).startswith("here: ") and "\n" not in str(error.value)
    assert message in str(error.value)
    assert path != "depths" or "found 'depths'" in str(error.value)


def test_a_whole_number_is_a_float_too():
    found = config_from_dict({"grid": {"resolution_m": 1}}, source="here")
    assert found.grid.resolution_m == 1.0 and type(found.grid.resolution_m) is float
