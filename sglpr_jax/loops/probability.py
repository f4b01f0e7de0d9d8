"""How probable it is that two scans show one place: a logistic model of what retrieval and verification found."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

DEFAULTS = Path(__file__).with_name("probability.json")
"""Models fitted in simulated towns, by the hash of the weights; "" is for all others. See docs/decisions/loops.md."""
RIDGE = 1.0
"""Pull of every weight towards 0, which keeps them finite where loops and others can be told apart without error."""
STEPS = 50


class Evidence(NamedTuple):
    """What speaks for pairs of scans, a number for each pair."""

    distance: Float[np.ndarray, "*n"]
    """Between the descriptors."""
    margin: Float[np.ndarray, "*n"]
    """How much farther the nearest descriptor of another place is, more than 20 m off; NaN where there is none."""
    correlation: Float[np.ndarray, "*n"]
    """Of the images."""
    second: Float[np.ndarray, "*n"]
    """The second peak as a share of the first."""

    @classmethod
    def of(cls, distance: float, margin: float, correlation: Any, second: Any) -> "Evidence":
        """Of one pair."""
        return cls(*(np.asarray(value, np.float64) for value in (distance, margin, correlation, second)))

    @classmethod
    def stack(cls, pairs: Sequence["Evidence"]) -> "Evidence":
        """Of several pairs, in order."""
        return cls(*np.array(pairs, np.float64).reshape(len(pairs), len(cls._fields)).T)


ALL = Evidence._fields
OF_IMAGES = ("correlation", "second")
"""What means the same whatever weights made the descriptors."""


@dataclasses.dataclass(frozen=True)
class LoopModel:
    """Probability = 1 / (1 + exp(-(bias + sum of weight * (value - mean) / scale)))."""

    weights: Mapping[str, float]
    """By the name of a field of `Evidence`; those that are not named do not count."""
    means: Mapping[str, float]
    scales: Mapping[str, float]
    bias: float
    made_with: str
    """On what it was fitted."""

    def probability(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """Of each pair, that it is a loop."""
        return np.asarray(1 / (1 + np.exp(-np.clip(self.log_odds(evidence), -50, 50))))

    def log_odds(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """The logarithm of probability / (1 - probability)."""
        return np.asarray(self.bias + self._standard(evidence) @ np.array(list(self.weights.values())))

    def to_json(self) -> dict[str, Any]:
        """What `from_json` reads."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, value: Any, *, source: str) -> "LoopModel":
        """Raises ValueError, naming the `source`, for anything but what `to_json` gave."""
        try:
            model = cls(**value)
            columns = (model.weights, model.means, model.scales)
            numbers = [model.bias, *(number for column in columns for number in column.values())]
            fits = set(model.weights) == set(model.means) == set(model.scales) <= set(ALL)
            fits = fits and all(math.isfinite(number) for number in numbers)
        except (TypeError, KeyError, AttributeError, OverflowError):
            fits = False
        if not fits:
            raise ValueError(f"{source}: expected a model of loops ({', '.join(ALL)}), found another value")
        return model

    def _standard(self, evidence: Evidence) -> Float[np.ndarray, "*n k"]:
        """The values that count, on the scale of the fit; one that is missing is as in the mean."""
        values = evidence._asdict()
        columns = [(np.asarray(values[name]) - self.means[name]) / self.scales[name] for name in self.weights]
        return np.nan_to_num(np.stack(columns, axis=-1))


def fit(
    evidence: Evidence, is_loop: Bool[np.ndarray, " n"], *, names: Sequence[str] = ALL, made_with: str = ""
) -> LoopModel:
    """The likeliest model of pairs that are known to be loops or not, by Newton's steps, with a small ridge.

    Loops and others count as they come: the probabilities are those of a place where as many of the pairs are loops.
    Raises ValueError where there are none of either.
    """
    if is_loop.all() or not is_loop.any():
        raise ValueError(f"expected loops and others to fit to, found {is_loop.sum()} loops of {len(is_loop)} pairs")
    values = {name: np.asarray(value, np.float64) for name, value in evidence._asdict().items() if name in names}
    means = {name: float(np.nanmean(value)) for name, value in values.items()}
    scales = {name: float(max(np.nanstd(value), 1e-9)) for name, value in values.items()}
    model = LoopModel(dict.fromkeys(values, 0.0), means, scales, 0.0, made_with)
    rows = np.column_stack([model._standard(evidence), np.ones(len(is_loop))])
    ridge = np.diag([RIDGE] * len(values) + [1e-6])
    found = np.zeros(rows.shape[1])
    for _ in range(STEPS):
        expected = 1 / (1 + np.exp(-np.clip(rows @ found, -50, 50)))
        gradient = rows.T @ (is_loop - expected) - ridge @ found
        curvature = (rows * (expected * (1 - expected))[:, None]).T @ rows + ridge
        found = found + np.linalg.solve(curvature, gradient).clip(-3, 3)
    weights = {name: float(weight) for name, weight in zip(values, found, strict=False)}
    return dataclasses.replace(model, weights=weights, bias=float(found[-1]))


def recalibrated(model: LoopModel, evidence: Evidence, is_loop: Bool[np.ndarray, " n"], *, made_with: str) -> LoopModel:
    """`model` on another sensor: its log odds stretched and shifted so that they are the likeliest there.

    These are two numbers, so that some hundred pairs that are known to be loops or not are enough. Raises ValueError
    where there are none of either.
    """
    log_odds = model.log_odds(evidence)
    single = fit(Evidence(*[log_odds] * len(ALL)), is_loop, names=ALL[:1])
    gain = single.weights[ALL[0]] / single.scales[ALL[0]]
    bias = single.bias - gain * single.means[ALL[0]]
    weights = {name: gain * weight for name, weight in model.weights.items()}
    return dataclasses.replace(model, weights=weights, bias=gain * model.bias + bias, made_with=made_with)


def default_model(weights_hash: str, *, path: Path = DEFAULTS) -> LoopModel:
    """The model that ships for these weights; one of the images alone for weights that none was fitted for."""
    return models(path).get(weights_hash) or models(path)[""]


def models(path: Path) -> dict[str, LoopModel]:
    """Models by the hash of their weights, from a JSON file. Raises FileNotFoundError, and ValueError for others."""
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON ({error})") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path}: expected models by the hash of their weights, found {type(found).__name__}")
    return {name: LoopModel.from_json(value, source=str(path)) for name, value in found.items()}
