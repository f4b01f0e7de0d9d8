"""Fits the model of loops that ships with the package: how probable it is that two scans show one place.

    python -m benchmarks loops --out build/fit
    python -m benchmarks loops fit build/fit

Every drive is searched without odometry, once as it is and once with a break of the motion in its middle, and every
third drive with odometry that drifts. All kinds of drives count alike. A pair is a loop by
`scoring.PoseErrors`. Each world is judged by a model that was fitted to the others.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from jaxtyping import Bool, Float
from scipy.special import expit

import sglpr_jax
from benchmarks.described import DescribedDrive, read_all, replay
from benchmarks.drives import Odometry
from benchmarks.quality.scoring import STOREY_M, pose_errors
from benchmarks.table import Table
from sglpr_jax.files import write_json
from sglpr_jax.loops.calibration import calibration_error, reliability
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.closure import planar_loop
from sglpr_jax.loops.consistency import are_consistent
from sglpr_jax.loops.probability import DEFAULT, TESTED, Evidence, LoopModel, fit
from sglpr_jax.loops.sequence import neighbour_weights
from sglpr_jax.models.params import Params
from sglpr_jax.se3 import transform

PAIRS = 300.0
"""The drives of a world with one kind of revisits and odometry count as this number of pairs."""
DRIFTING = 3
"""One of this number of drives is also searched with odometry."""
SURE = 0.99


class Pairs(NamedTuple):
    """Candidates of one drive that the motion allows."""

    world: str
    kind: str
    """World, revisits and odometry. All kinds count alike."""
    evidence: Evidence
    """Evidence of each pair alone."""
    neighbours: Float[np.ndarray, "n n"]
    """Weight of each pair as neighbour of another one, negative if they disagree."""
    is_loop: Bool[np.ndarray, " n"]
    is_known: Bool[np.ndarray, " n"]
    """Whether a pair is certainly a loop or certainly none."""

    def support(self, model: LoopModel) -> Float[np.ndarray, " n"]:
        """Evidence of the neighbours of each pair."""
        return self.neighbours @ model.strength(self.evidence)


class Judged(NamedTuple):
    """Pairs that are certainly loops or certainly none, judged by a model of other worlds."""

    probability: Float[np.ndarray, " n"]
    """With neighbours."""
    alone: Float[np.ndarray, " n"]
    """Without neighbours."""
    is_loop: Bool[np.ndarray, " n"]


def fit_model(
    drives: tyro.conf.Positional[Path],
    *,
    weights: str = "sglpr",
    without_each: bool = False,
    out: Path = DEFAULT,
) -> None:
    """Fit and write the model.

    The table has the pairs of each world, with neighbours and alone, the share of right pairs above two
    probabilities, the wrong pairs, and the expected calibration error.

    Args:
        drives: folder of `loops`.
        weights: the model that describes the scans.
        without_each: also judge models without each term.
        out: the file to write.
    """
    params, pairs = sglpr_jax.load(weights), list[Pairs]()
    for number, drive in enumerate(read_all(drives)):
        pairs += [_pairs(drive, "none", params), _pairs(drive, "none", params, breaks=True)]
        pairs += [] if number % DRIFTING else [_pairs(drive, "drifting", params)]
    table = Table("world", "right", f">= {SURE}", ">= 0.5", "wrong", f">= {SURE}", ">= 0.5", "ECE")
    judged = held_out(pairs)
    for world, of_world in judged.items():
        table.add(world, *_cells(of_world.probability, of_world.is_loop))
        table.add(f"{world}, alone", *_cells(of_world.alone, of_world.is_loop))
    everything = _joined(judged)
    table.add("all", *_cells(everything.probability, everything.is_loop))
    for name in (*Evidence._fields, "support") if without_each else ():
        reduced = _joined(held_out(pairs, without=name))
        table.add(f"without {name}", *_cells(reduced.probability, reduced.is_loop))
    for one in reliability(everything.probability, everything.is_loop):
        stated = f"{one.low:.2f} to {one.high:.2f}: {one.pairs} pairs, stated {one.probability:.3f}"
        print(f"{stated}, {one.share:.3f} are loops")
    model = fitted(pairs)
    write_json(out, model.to_json())
    print(model)


def _pairs(drive: DescribedDrive, odometry: Odometry, params: Params, *, breaks: bool = False) -> Pairs:
    """The candidates of one drive that the motion allows. With `breaks`, the motion is unknown in the middle."""
    search, poses = CandidateSearch(params), drive.odometry(odometry, int(drive.facts["seed"]))
    candidates = [one for frame in replay(search, drive, poses, breaks=breaks) for one in frame]
    candidates = [one for one in candidates if one.evidence.deviation <= search.present_drift.max_deviation]
    fits = [transform(*(float(value) for value in one.alignment[:3])) for one in candidates]
    errors = pose_errors([(one.query, one.match) for one in candidates], np.array(fits), drive.world_from_lidar)
    evidence = np.array([one.evidence for one in candidates], np.float64).reshape(-1, len(Evidence._fields))
    loops = [planar_loop(one.query, one.match, one.alignment, probability=0.5) for one in candidates]
    way_m = np.maximum.accumulate([float(search.motion.travelled[one.query]) for one in candidates])
    agreeing = are_consistent(loops, search.motion.path, drift=search.present_drift)
    neighbours = neighbour_weights(way_m, np.arange(len(candidates))) * np.where(agreeing, 1.0, -1.0)
    wrong = errors.wrong if odometry != "none" else errors.wrong & (errors.storey_m <= STOREY_M)
    kind = f"{drive.facts['world']}-{drive.facts['route']}-{odometry}"
    return Pairs(drive.facts["world"], kind, Evidence(*evidence.T), neighbours, errors.right, errors.right | wrong)


def held_out(pairs: Sequence[Pairs], *, without: str | None = None) -> dict[str, Judged]:
    """Judge each world by a model that was fitted to the others, or by one that lacks a term."""
    judged = {}
    for world in dict.fromkeys(one.world for one in pairs):
        model = fitted([one for one in pairs if one.world != world], without=without)
        of_world = [one for one in pairs if one.world == world]
        known = np.concatenate([one.is_known for one in of_world])
        tested = [model.tested_log_odds(one.evidence, one.support(model)) for one in of_world]
        alone = [model.log_odds(one.evidence) for one in of_world]
        is_loop = np.concatenate([one.is_loop for one in of_world])[known]
        judged[world] = Judged(*(expit(np.concatenate(odds)[known]) for odds in (tested, alone)), is_loop)
    return judged


def _joined(judged: dict[str, Judged]) -> Judged:
    return Judged(*(np.concatenate(values) for values in zip(*judged.values(), strict=True)))


def _cells(probability: Float[np.ndarray, " n"], is_loop: Bool[np.ndarray, " n"]) -> list[str]:
    """Counts of right and wrong pairs, the shares of the right and the numbers of the wrong ones above limits, and the
    expected calibration error."""
    right, wrong = probability[is_loop], probability[~is_loop]
    shares = [f"{(right >= limit).mean():.2f}" if len(right) else "" for limit in (SURE, 0.5)]
    error = f"{calibration_error(reliability(probability, is_loop)):.3f}"
    return [str(len(right)), *shares, str(len(wrong)), *(str((wrong >= limit).sum()) for limit in (SURE, 0.5)), error]


def fitted(pairs: Sequence[Pairs], *, without: str | None = None) -> LoopModel:
    """Model of some drives, of which each kind counts alike. It may lack one term."""
    counts = Counter[str]()
    for one in pairs:
        counts[one.kind] += int(one.is_known.sum())
    weights = np.concatenate([np.full(one.is_known.sum(), PAIRS / max(counts[one.kind], 1)) for one in pairs])
    evidence = Evidence(*map(np.concatenate, zip(*(one.evidence for one in pairs), strict=True)))
    known = np.concatenate([one.is_known for one in pairs])
    is_loop = np.concatenate([one.is_loop for one in pairs])[known]
    terms = {name: values[known] for name, values in evidence._asdict().items() if name != without}
    alone = fit(terms, is_loop, weights=weights)
    worlds = ", ".join(dict.fromkeys(one.world for one in pairs))
    about = f"{is_loop.sum()} loops and {(~is_loop).sum()} others of {len(pairs)} simulated drives ({worlds})"
    model = LoopModel(alone, f"{about}; benchmarks/quality/fit.py")
    support = np.concatenate([one.support(model) for one in pairs])
    values = {"alone": model.log_odds(evidence), "support": support, "surprise": evidence.surprise}
    tested = {name: values[name][known] for name in TESTED if name != without}
    return dataclasses.replace(model, tested=fit(tested, is_loop, weights=weights))
