"""A configuration made by hand, by a preset or by flags holds what its annotations say, and nothing else."""

import copy
import dataclasses
from typing import Literal

import pytest

from sglpr_jax.fields import Positive, Share, Sizes, check_fields
from sglpr_jax.grid import Grid
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.backbone_config import SglprConfig, SwinConfig
from sglpr_jax.models.config import HeadConfig, ModelConfig
from sglpr_jax.training.config import LossConfig, OptimizerConfig, TrainConfig


@dataclasses.dataclass(frozen=True)
class Example:
    """One field of every kind."""

    share: Share = 0.5
    name: Literal["a", "b"] = "a"
    sizes: Sizes = ()
    pair: tuple[int, float] | None = None
    clip: Positive | None = None
    grid: Grid = Grid()

    def __post_init__(self):
        check_fields(self)


@pytest.mark.parametrize(
    "values", [{}, {"share": 1}, {"name": "b"}, {"sizes": (1, 2)}, {"pair": (1, 2.5)}, {"clip": 2.0}]
)
def test_valid_values_are_accepted(values):
    assert dataclasses.asdict(Example(**values)) == dataclasses.asdict(Example()) | values


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"share": 1.5}, "Example.share: expected a number from 0 up to 1, found 1.5"),
        ({"share": True}, "Example.share: expected a value of type float, found True"),
        ({"share": float("nan")}, "Example.share: expected a finite number, found nan"),
        ({"name": "A"}, "Example.name: expected one of 'a', 'b', found 'A'"),
        ({"sizes": (0,)}, "Example.sizes: expected a number from 1 up to 1048576, found 0"),
        ({"pair": (1,)}, "Example.pair: expected a list of 2, found (1,)"),
        ({"clip": 0.0}, "Example.clip: expected a number above 0, found 0.0"),
        ({"grid": {}}, "Example.grid: expected the fields of a Grid, found {}"),
        ({"name": "a" * 100}, f"Example.name: expected one of 'a', 'b', found '{'a' * 56}..."),
    ],
)
def test_an_invalid_value_is_an_error_with_field_expected_and_found(values, message):
    with pytest.raises(ValueError) as error:
        Example(**values)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("config", "values"),
    [
        (Grid, dict(height=128.0)),
        (HeadConfig, dict(pooling="gem")),
        (ModelConfig, dict(blind_m=-2.0)),
        (SwinConfig, dict(heads=(5, 6, 12, 24))),
        (SglprConfig, dict(depths=(), heads=(2,))),
        (TupleConfig, dict(positive_m=float("inf"))),
        (LossConfig, dict(margin="0.3")),
        (OptimizerConfig, dict(warmup_steps=1.5)),
        (TrainConfig, dict(model=None)),
    ],
)
def test_every_configuration_checks_its_fields(config, values):
    """Set behind its back: tests check the types of all arguments, a user's Python does not."""
    made = copy.copy(config())
    for name, value in values.items():
        object.__setattr__(made, name, value)
    with pytest.raises(ValueError, match=r"expected .*found "):
        made.__post_init__()
