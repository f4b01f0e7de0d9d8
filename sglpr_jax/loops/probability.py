"""Probability that two scans show one place: a monotone additive model of the evidence.

The log odds are a sum of piecewise linear functions, one for each field of `Evidence`. The functions are monotone and
bounded. Therefore a perfect fit of the images cannot outweigh other places that fit as well.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

DEFAULT = Path(__file__).with_name("probability.json")
"""File of the model fitted in the simulator. See docs/decisions/loops.md."""
KNOTS: Mapping[str, tuple[float, ...]] = {
    "peak_ratio": (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
    "ambiguity_ratio": (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
    "deviation": (0.5, 1.0, 1.5, 2.0, 3.0, 4.0),
    "surprise": (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0),
}
"""Knots of the piecewise linear functions. Outside the knots they are constant."""
RISING = ("surprise",)
"""Fields whose functions rise. The other functions fall."""
MAX_STRENGTH = 4.0
"""Maximum log odds with which a pair counts as neighbour."""
RIDGE = 0.02
"""Weight of the penalty on squared steps between knots. It keeps the functions finite and smooth."""


class Evidence(NamedTuple):
    """Evidence for pairs of scans, one number of each kind for each pair (`Comparer`)."""

    peak_ratio: Float[np.ndarray, "*n"]
    """Correlation at the second-best pose of the two images, divided by that at the best pose."""
    ambiguity_ratio: Float[np.ndarray, "*n"]
    """Correlation with the best other place, divided by the correlation with the match. NaN if the drive has too few
    other places to tell."""
    deviation: Float[np.ndarray, "*n"]
    """Deviation of the pose from the motion, in standard deviations."""
    surprise: Float[np.ndarray, "*n"]
    """Logarithm of all poses over those that the motion allows. 0 if the motion says nothing."""

    @classmethod
    def of(cls, peak_ratio: Any, ambiguity_ratio: Any, deviation: Any, surprise: Any) -> "Evidence":
        """Create the evidence of one pair."""
        values = (peak_ratio, ambiguity_ratio, deviation, surprise)
        return cls(*(np.asarray(value, np.float64) for value in values))

    @classmethod
    def stack(cls, pairs: Sequence["Evidence"]) -> "Evidence":
        """Stack the evidence of several pairs, in order."""
        return cls(*np.array(pairs, np.float64).reshape(len(pairs), len(cls._fields)).T)


ALL = Evidence._fields
OF_REPETITION = ("peak_ratio", "ambiguity_ratio")
"""Fields that compare the match with other poses and places."""


class Curve(NamedTuple):
    """A piecewise linear function, constant outside its knots."""

    knots: tuple[float, ...]
    values: tuple[float, ...]
    unknown: float = 0.0
    """Value for NaN."""

    def __call__(self, numbers: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Evaluate the function."""
        return np.where(np.isnan(numbers), self.unknown, np.interp(numbers, self.knots, self.values))


@dataclasses.dataclass(frozen=True)
class LoopModel:
    """Model of the probability of loops: 1 / (1 + exp(-(bias + sum of curves)))."""

    curves: Mapping[str, Curve]
    """Curves by the field of `Evidence`. Fields without a curve are not used."""
    bias: float
    made_with: str
    """Description of the pairs that the model was fitted to."""

    def probability(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """Probability that each pair is a loop."""
        return np.asarray(1 / (1 + np.exp(-np.clip(self.log_odds(evidence), -50, 50))))

    def log_odds(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """Log odds of each pair: the logarithm of probability / (1 - probability)."""
        return np.asarray(self.bias + sum(self.contributions(evidence).values()))

    def contributions(self, evidence: Evidence) -> dict[str, Float[np.ndarray, "*n"]]:
        """Term of each field in the log odds."""
        values = evidence._asdict()
        return {name: curve(np.asarray(values[name], np.float64)) for name, curve in self.curves.items()}

    def log_odds_without_ambiguity(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """Log odds if no other pose and place fitted as well as the match."""
        parts = self.contributions(evidence)
        best = {name: max(self.curves[name].values) for name in OF_REPETITION if name in parts}
        return np.asarray(self.bias + sum((parts | best).values()))

    def strength(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """How much a pair says about its neighbours: its log odds by the images, from 0 to `MAX_STRENGTH`.

        The motion between the two passes is common to neighbours, so it does not count again.
        """
        nothing = {"deviation": np.zeros_like(evidence.deviation), "surprise": np.zeros_like(evidence.surprise)}
        return np.clip(self.log_odds(evidence._replace(**nothing)), 0.0, MAX_STRENGTH)

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON value for `from_json`."""
        curves = {name: curve._asdict() for name, curve in self.curves.items()}
        return {"curves": curves, "bias": self.bias, "made_with": self.made_with}

    @classmethod
    def from_json(cls, value: Any, *, source: str) -> "LoopModel":
        """Build a model from the output of `to_json`.

        Raises ValueError if it is invalid. The message names `source`, its file.
        """
        try:
            curves = {
                name: Curve(tuple(one["knots"]), tuple(one["values"]), one["unknown"])
                for name, one in value["curves"].items()
            }
            model = cls(curves, value["bias"], value["made_with"])
            numbers = [model.bias, *(n for one in curves.values() for n in (*one.knots, *one.values, one.unknown))]
            fits = set(curves) <= set(ALL) and all(math.isfinite(number) for number in numbers)
            fits = fits and all(_is_curve(curve) for curve in curves.values())
        except (TypeError, KeyError, AttributeError, OverflowError):
            fits = False
        if not fits:
            raise ValueError(f"{source}: expected a loop model ({', '.join(ALL)}), found another value")
        return model


def _is_curve(curve: Curve) -> bool:
    return len(curve.knots) == len(curve.values) > 0 and bool(np.all(np.diff(curve.knots) > 0))


def fit(
    evidence: Evidence,
    is_loop: Bool[np.ndarray, " n"],
    *,
    names: Sequence[str] = ALL,
    weights: Float[np.ndarray, " n"] | None = None,
    made_with: str = "",
) -> LoopModel:
    """Fit a monotone model to labelled pairs by maximum likelihood.

    Arguments:
      evidence: Evidence of the pairs.
      is_loop: Whether each pair is a loop.
      names: Fields of the evidence that the model uses.
      weights: Weights of the pairs, by default all equal.
      made_with: Description of the pairs.

    Raises:
      ValueError: If all pairs are loops or no pair is.
    """
    if is_loop.all() or not is_loop.any():
        raise ValueError(f"expected loops and other pairs to fit, found {is_loop.sum()} loops of {len(is_loop)} pairs")
    weights = np.ones(len(is_loop)) if weights is None else weights
    missing = [np.isnan(getattr(evidence, name)) for name in names]
    columns = np.concatenate([_rises(name, getattr(evidence, name)) for name in names], axis=1)
    columns = np.column_stack([columns, *missing, np.ones(len(is_loop))]).astype(np.float64)
    sign = np.where(is_loop, 1.0, -1.0)

    def cost(steps: Float[np.ndarray, " k"]) -> tuple[float, Float[np.ndarray, " k"]]:
        margin = sign * (columns @ steps)
        slope = -weights * sign / (1 + np.exp(np.clip(margin, -50, 50)))
        penalty = RIDGE * np.append(steps[:-1], 0.0)
        return float(weights @ np.logaddexp(0, -margin) + penalty @ steps / 2), columns.T @ slope + penalty

    bounds = [(0.0, None)] * (columns.shape[1] - 1) + [(None, None)]
    steps = minimize(cost, np.zeros(columns.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x
    curves, used = {}, 0
    for name in names:
        count = len(KNOTS[name]) - 1
        rise = np.concatenate([[0.0], np.cumsum(steps[used : used + count])])
        values = rise if name in RISING else (rise[-1] - rise)
        unknown = float(steps[len(steps) - 1 - len(names) + names.index(name)])
        curves[name] = Curve(KNOTS[name], tuple(np.round(values, 4).tolist()), round(unknown, 4))
        used += count
    return LoopModel(curves, float(steps[-1]), made_with)


def _rises(name: str, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
    """For each value and each interval of knots, how far the value is from the worse end of the interval, from 0 to
    1.
    """
    knots = np.array(KNOTS[name])
    made = np.clip((np.asarray(values)[:, None] - knots[None, :-1]) / np.diff(knots)[None], 0, 1)
    return np.nan_to_num(made if name in RISING else 1 - made, nan=0.0)


def recalibrated(model: LoopModel, evidence: Evidence, is_loop: Bool[np.ndarray, " n"], *, made_with: str) -> LoopModel:
    """Calibrate a model for another sensor: scale and shift its log odds by maximum likelihood.

    These are only two numbers, so a few hundred pairs are enough. Raises the errors of `fit`.
    """
    if is_loop.all() or not is_loop.any():
        raise ValueError(f"expected loops and other pairs to fit, found {is_loop.sum()} loops of {len(is_loop)} pairs")
    log_odds, sign = model.log_odds(evidence), np.where(is_loop, 1.0, -1.0)

    def cost(line: Float[np.ndarray, " 2"]) -> float:
        return float(np.logaddexp(0, -sign * (line[0] * log_odds + line[1])).sum() + (line[0] - 1) ** 2)

    gain, shift = minimize(cost, np.array([1.0, 0.0]), method="L-BFGS-B", bounds=[(0.0, None), (None, None)]).x
    curves = {
        name: Curve(curve.knots, tuple(gain * value for value in curve.values), gain * curve.unknown)
        for name, curve in model.curves.items()
    }
    return LoopModel(curves, float(gain * model.bias + shift), made_with)


def default_model(path: Path = DEFAULT) -> LoopModel:
    """Read the shipped model, or that of another file.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is invalid.
    """
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON ({error})") from error
    return LoopModel.from_json(found, source=str(path))
