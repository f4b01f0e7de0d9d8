"""Probability that two scans show one place: a monotone additive model of the evidence.

The log odds are a sum of bounded, monotone, piecewise linear functions, one for each field of `Evidence`. Since they
are bounded, a perfect fit of the images cannot outweigh other places that fit as well. A second model of the same kind
adds the evidence of neighbouring pairs.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import expit

from sglpr_jax.files import read_json

DEFAULT = Path(__file__).with_name("probability.json")
"""File of the model fitted in the simulator. See docs/decisions.md."""
KNOTS: Mapping[str, tuple[float, ...]] = {
    "ambiguity_ratio": (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
    "along_m": (0.03, 0.06, 0.1, 0.2, 0.4, 1.0, 3.0),
    "deviation": (0.5, 1.0, 1.5, 2.0, 3.0, 4.0),
    "surprise": (-4.0, -2.0, 0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0),
    "alone": (-10.0, -6.0, -4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0, 6.0, 9.0),
    "support": (-12.0, -6.0, -3.0, -1.0, 0.0, 1.0, 2.0, 4.0, 6.0, 9.0, 13.0, 18.0),
}
"""Knots of the piecewise linear functions, by argument. Outside the knots they are constant."""
RISING = ("surprise", "alone", "support")
"""Arguments whose functions rise. The other functions fall."""
MAX_STRENGTH = 4.0
"""Maximum log odds with which a pair supports its neighbours."""
RIDGE = 0.02
"""Weight of the penalty on squared steps between knots. It keeps the functions finite and smooth."""


class Evidence(NamedTuple):
    """Evidence that pairs of scans show one place: one number in each field for each pair (`KeyframeComparison`)."""

    ambiguity_ratio: Float[np.ndarray, "*n"]
    """Highest correlation with other places, or at other poses, divided by the correlation with the match."""
    along_m: Float[np.ndarray, "*n"]
    """Standard deviation of the position along its least certain direction, in metres. It is large between walls."""
    deviation: Float[np.ndarray, "*n"]
    """Deviation of the pose from the motion, in standard deviations."""
    surprise: Float[np.ndarray, "*n"]
    """Logarithm of the number of poses of a lookalike over the number of poses that the motion allows. It is negative
    if the motion is unknown."""

    @classmethod
    def of(cls, *values: Any) -> "Evidence":
        """Create the evidence of one pair, from numbers in the order of the fields."""
        return cls(*(np.asarray(value, np.float64) for value in values))

    @classmethod
    def stack(cls, pairs: Sequence["Evidence"]) -> "Evidence":
        """Stack the evidence of several pairs, in order."""
        return cls(*np.array(pairs, np.float64).reshape(len(pairs), len(cls._fields)).T)


TESTED = ("alone", "support", "surprise")
"""Arguments of the model with neighbours: log odds of a pair alone, support by its neighbours, and surprise."""


class Curve(NamedTuple):
    """A piecewise linear function, constant outside its knots."""

    knots: tuple[float, ...]
    values: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class AdditiveModel:
    """Model of log odds: the bias plus the sum of the curves, each at the value of its argument."""

    curves: Mapping[str, Curve]
    """Curves by the name of their argument. Arguments without a curve are not used."""
    bias: float

    def __call__(self, values: Mapping[str, Float[np.ndarray, "*n"]]) -> Float[np.ndarray, "*n"]:
        """Log odds of pairs, from the value of each argument at each pair."""
        terms = (np.interp(values[name], curve.knots, curve.values) for name, curve in self.curves.items())
        return np.asarray(self.bias + sum(terms))

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON value for `from_json`."""
        return {"curves": {name: curve._asdict() for name, curve in self.curves.items()}, "bias": self.bias}

    @classmethod
    def from_json(cls, value: Any, names: Sequence[str]) -> "AdditiveModel":
        """Build a model from the output of `to_json`. Arguments must be in `names`. Raises ValueError if invalid."""
        try:
            curves = {
                name: Curve(tuple(curve["knots"]), tuple(curve["values"])) for name, curve in value["curves"].items()
            }
            is_valid = set(curves) <= set(names) and math.isfinite(value["bias"])
            for knots, heights in curves.values():
                is_valid &= len(knots) == len(heights) > 0 and all(map(math.isfinite, (*knots, *heights)))
                is_valid &= bool((np.diff(knots) > 0).all())  # knots ascend
        except (TypeError, KeyError, AttributeError, OverflowError):
            is_valid = False
        if not is_valid:
            raise ValueError(f"expected curves of {', '.join(names)} and a bias, found others")
        return cls(curves, value["bias"])


_IDENTITY = Curve((-50.0, 50.0), (-50.0, 50.0))
SUM_OF_SUPPORT = AdditiveModel({"alone": _IDENTITY, "support": _IDENTITY}, 0.0)
"""Model with neighbours that is not fitted: the log odds of a pair alone plus the support by its neighbours."""


@dataclasses.dataclass(frozen=True)
class LoopModel:
    """Model of the probability of loops."""

    alone: AdditiveModel
    """Log odds of a pair by its `Evidence`, without neighbours."""
    made_with: str
    """Description of the pairs that the model was fitted to."""
    tested: AdditiveModel = SUM_OF_SUPPORT
    """Log odds of a pair given its neighbours, by the arguments `TESTED`."""

    def probability(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """Probability that each pair is a loop, without neighbours."""
        return np.asarray(expit(self.log_odds(evidence)))

    def log_odds(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """Log odds of each pair without neighbours: the logarithm of probability / (1 - probability)."""
        return self.alone(evidence._asdict())

    def tested_log_odds(self, evidence: Evidence, support: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Log odds of each pair, given the support by its neighbours."""
        return self.tested({"alone": self.log_odds(evidence), "support": support, "surprise": evidence.surprise})

    def strength(self, evidence: Evidence) -> Float[np.ndarray, "*n"]:
        """Strength with which each pair supports its neighbours, from 0 to `MAX_STRENGTH`.

        It is the log odds by the images, without the motion: that is nearly the same for all neighbours, so it would
        count several times.
        """
        without_motion = evidence._replace(
            deviation=np.zeros_like(evidence.deviation), surprise=np.zeros_like(evidence.surprise)
        )
        return np.clip(self.log_odds(without_motion), 0.0, MAX_STRENGTH)

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON value for `from_json`."""
        return {"alone": self.alone.to_json(), "tested": self.tested.to_json(), "made_with": self.made_with}

    @classmethod
    def from_json(cls, value: Any, *, source: str) -> "LoopModel":
        """Build a model from the output of `to_json`. Raises ValueError, which names its file `source`, if invalid."""
        try:
            alone, tested = value["alone"], value["tested"]
            return cls(
                AdditiveModel.from_json(alone, Evidence._fields),
                value["made_with"],
                AdditiveModel.from_json(tested, TESTED),
            )
        except (TypeError, KeyError) as error:
            raise ValueError(f"{source}: expected a loop model, found another value") from error
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error


def fit(
    values: Mapping[str, Float[np.ndarray, " n"]],
    is_loop: Bool[np.ndarray, " n"],
    *,
    weights: Float[np.ndarray, " n"] | None = None,
) -> AdditiveModel:
    """Fit a monotone model to labelled pairs by maximum likelihood, by default with equal weights.

    `values` has the value of each argument (a name of `KNOTS`) at each pair. Raises ValueError if all pairs are loops,
    or no pair is.
    """
    from scipy.optimize import minimize  # imported here because the import is slow

    if is_loop.all() or not is_loop.any():
        raise ValueError(f"expected loops and other pairs to fit, found {is_loop.sum()} loops of {len(is_loop)} pairs")
    weights = np.ones(len(is_loop)) if weights is None else weights
    # Log odds are a product of `columns` (pairs by intervals between knots, and the bias) and steps. A column is the
    # share of its interval, from 0 to 1, that lies on the worse side of the value. A step is the rise of the curve over
    # the interval, so curves are monotone if steps are not negative.
    columns = []
    for name, argument in values.items():
        knots = np.array(KNOTS[name])
        shares = np.clip((np.asarray(argument)[:, None] - knots[None, :-1]) / np.diff(knots)[None], 0, 1)
        columns.append(shares if name in RISING else 1 - shares)
    columns = np.concatenate([*columns, np.ones((len(is_loop), 1))], axis=1)
    sign = np.where(is_loop, 1.0, -1.0)

    def cost(steps: Float[np.ndarray, " k"]) -> tuple[float, Float[np.ndarray, " k"]]:
        """Negative log likelihood with penalty, and its gradient."""
        margin = sign * (columns @ steps)
        penalty = RIDGE * np.append(steps[:-1], 0.0)  # not on the bias
        gradient = columns.T @ (-weights * sign * expit(-margin)) + penalty
        return float(weights @ np.logaddexp(0, -margin) + penalty @ steps / 2), gradient

    bounds = [(0.0, None)] * (columns.shape[1] - 1) + [(None, None)]
    steps = minimize(cost, np.zeros(columns.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x
    curves, first = {}, 0
    for name in values:
        count = len(KNOTS[name]) - 1
        rise = np.concatenate([[0.0], np.cumsum(steps[first : first + count])])
        heights = rise if name in RISING else (rise[-1] - rise)
        curves[name] = Curve(KNOTS[name], tuple(np.round(heights, 4).tolist()))
        first += count
    return AdditiveModel(curves, float(steps[-1]))


def recalibrated(model: LoopModel, evidence: Evidence, is_loop: Bool[np.ndarray, " n"], *, made_with: str) -> LoopModel:
    """Scale and shift the log odds of pairs without neighbours for another sensor, from labelled pairs.

    Gain and shift have maximum likelihood, with a penalty on gains other than 1. `made_with` describes the result.
    """
    from scipy.optimize import minimize  # imported here because the import is slow

    log_odds, sign = model.log_odds(evidence), np.where(is_loop, 1.0, -1.0)

    def cost(gain_and_shift: Float[np.ndarray, " 2"]) -> float:
        gain, shift = gain_and_shift
        return float(np.logaddexp(0, -sign * (gain * log_odds + shift)).sum() + (gain - 1) ** 2)

    gain, shift = minimize(cost, np.array([1.0, 0.0]), method="L-BFGS-B", bounds=[(0.0, None), (None, None)]).x
    curves = {
        name: Curve(curve.knots, tuple(float(gain) * height for height in curve.values))
        for name, curve in model.alone.curves.items()
    }
    alone = AdditiveModel(curves, float(gain) * model.alone.bias + float(shift))
    return LoopModel(alone, made_with, model.tested)


def default_model(path: Path = DEFAULT) -> LoopModel:
    """Read the shipped model, or that of another file. Raises FileNotFoundError or, if it is invalid, ValueError."""
    return LoopModel.from_json(read_json(path), source=str(path))
