"""Fits the shipped model of the probability that two scans show the same place.

    python -m benchmarks loops --out build/fit
    python -m benchmarks loops fit build/fit

Every drive is searched twice without odometry, the second time with an interruption of the motion in its middle. Every
third drive is also searched with drifting odometry. All kinds of drives have the same weight. A pair is a loop by
`scoring.PoseErrors`. Each world is scored with a model that was fitted to the other worlds.
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
from sglpr_jax.models.weights import Params

PAIRS = 300.0
"""Total weight of the pairs of all drives of a kind: a world with one kind of revisits and of odometry."""
DRIFTING = 3
"""Every n-th drive is also searched with drifting odometry."""
SURE = 0.99  # probability of a sure pair


class Pairs(NamedTuple):
    """Candidates of one drive that the motion allows."""

    world: str
    kind: str
    """World, revisits and odometry. All kinds have the same weight."""
    evidence: Evidence
    """Evidence of each pair, without its neighbours."""
    neighbours: Float[np.ndarray, "n n"]
    """Weight of each pair (column) as neighbour of another one (row), negative if their poses are inconsistent."""
    is_loop: Bool[np.ndarray, " n"]
    is_known: Bool[np.ndarray, " n"]
    """Whether the pair is known to be a loop or known not to be a loop."""

    def support(self, model: LoopModel) -> Float[np.ndarray, " n"]:
        """Weighted sum of the evidence of the neighbours of each pair."""
        return self.neighbours @ model.strength(self.evidence)


class Scored(NamedTuple):
    """Pairs with known labels, and their probabilities by a model that was fitted to other worlds."""

    probability: Float[np.ndarray, " n"]  # from the evidence of the pair and of its neighbours
    alone: Float[np.ndarray, " n"]  # from the evidence of the pair
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
        without_each: also score models that lack one term.
        out: the file to write.
    """
    params, pairs = sglpr_jax.load(weights), list[Pairs]()
    for number, drive in enumerate(read_all(drives)):
        pairs += [_pairs(drive, "none", params), _pairs(drive, "none", params, breaks=True)]
        if number % DRIFTING == 0:
            pairs.append(_pairs(drive, "drifting", params))
    table = Table("world", "right", f">= {SURE}", ">= 0.5", "wrong", f">= {SURE}", ">= 0.5", "ECE")
    scored_by_world = score_held_out(pairs)
    for world, scored in scored_by_world.items():
        table.add(world, *_cells(scored.probability, scored.is_loop))
        table.add(f"{world}, alone", *_cells(scored.alone, scored.is_loop))
    all_scored = _joined(scored_by_world)
    table.add("all", *_cells(all_scored.probability, all_scored.is_loop))
    for name in (*Evidence._fields, "support") if without_each else ():
        reduced = _joined(score_held_out(pairs, without=name))
        table.add(f"without {name}", *_cells(reduced.probability, reduced.is_loop))
    for bin in reliability(all_scored.probability, all_scored.is_loop):
        stated = f"{bin.low:.2f} to {bin.high:.2f}: {bin.pairs} pairs, stated {bin.probability:.3f}"
        print(f"{stated}, {bin.share:.3f} are loops")
    model = fit_to(pairs)
    write_json(out, model.to_json())
    print(model)


def _pairs(drive: DescribedDrive, odometry: Odometry, params: Params, *, breaks: bool = False) -> Pairs:
    """Searches a drive. Returns its candidates whose poses the odometry allows.

    With `breaks`, the motion to the scan in the middle of the drive is unknown.
    """
    search, poses = CandidateSearch(params), drive.odometry(odometry, int(drive.facts["seed"]))
    candidates = [pair for of_scan in replay(search, drive, poses, breaks=breaks) for pair in of_scan]
    candidates = [pair for pair in candidates if pair.evidence.deviation <= search.present_drift.max_deviation]
    estimated_poses = [pair.alignment.match_from_query for pair in candidates]
    scans = [(int(search.rows[pair.query]), int(search.rows[pair.match])) for pair in candidates]
    errors = pose_errors(scans, np.array(estimated_poses), drive.world_from_lidar)
    evidence = np.array([pair.evidence for pair in candidates], np.float64).reshape(-1, len(Evidence._fields))
    loops = [planar_loop(pair.query, pair.match, pair.alignment, probability=0.5) for pair in candidates]
    travelled_m = np.maximum.accumulate([float(search.motion.travelled[pair.query]) for pair in candidates])
    consistent = are_consistent(loops, search.motion.path, drift=search.present_drift)
    neighbours = neighbour_weights(travelled_m, np.arange(len(candidates))) * np.where(consistent, 1.0, -1.0)
    wrong = errors.wrong
    if odometry == "none":  # without odometry, storeys that look the same cannot be distinguished
        wrong = wrong & (errors.storey_m <= STOREY_M)
    kind = f"{drive.facts['world']}-{drive.facts['route']}-{odometry}"
    return Pairs(drive.facts["world"], kind, Evidence(*evidence.T), neighbours, errors.right, errors.right | wrong)


def score_held_out(pairs: Sequence[Pairs], *, without: str | None = None) -> dict[str, Scored]:
    """Scores each world with a model that was fitted to the other worlds, without the term `without`."""
    scored = {}
    for world in dict.fromkeys(drive.world for drive in pairs):
        model = fit_to([drive for drive in pairs if drive.world != world], without=without)
        of_world = [drive for drive in pairs if drive.world == world]
        known = np.concatenate([drive.is_known for drive in of_world])
        tested = [model.tested_log_odds(drive.evidence, drive.support(model)) for drive in of_world]
        alone = [model.log_odds(drive.evidence) for drive in of_world]
        is_loop = np.concatenate([drive.is_loop for drive in of_world])[known]
        scored[world] = Scored(*(expit(np.concatenate(odds)[known]) for odds in (tested, alone)), is_loop)
    return scored


def _joined(scored_by_world: dict[str, Scored]) -> Scored:
    """Scored pairs of all worlds."""
    return Scored(*(np.concatenate(arrays) for arrays in zip(*scored_by_world.values(), strict=True)))


def _cells(probability: Float[np.ndarray, " n"], is_loop: Bool[np.ndarray, " n"]) -> list[str]:
    """Cells: number of loops, their shares with a probability of at least SURE and 0.5, the same for other pairs as
    numbers, and the expected calibration error."""
    right, wrong = probability[is_loop], probability[~is_loop]
    shares = [f"{(right >= limit).mean():.2f}" if len(right) else "" for limit in (SURE, 0.5)]
    error = f"{calibration_error(reliability(probability, is_loop)):.3f}"
    return [str(len(right)), *shares, str(len(wrong)), *(str((wrong >= limit).sum()) for limit in (SURE, 0.5)), error]


def fit_to(pairs: Sequence[Pairs], *, without: str | None = None) -> LoopModel:
    """Fits a model to drives, with the same weight for each kind of drive, and without the term `without`."""
    counts = Counter[str]()
    for drive in pairs:
        counts[drive.kind] += int(drive.is_known.sum())
    weights = np.concatenate([np.full(drive.is_known.sum(), PAIRS / max(counts[drive.kind], 1)) for drive in pairs])
    evidence = Evidence(*map(np.concatenate, zip(*(drive.evidence for drive in pairs), strict=True)))
    known = np.concatenate([drive.is_known for drive in pairs])
    is_loop = np.concatenate([drive.is_loop for drive in pairs])[known]
    terms = {name: term[known] for name, term in evidence._asdict().items() if name != without}
    alone = fit(terms, is_loop, weights=weights)
    worlds = ", ".join(dict.fromkeys(drive.world for drive in pairs))
    source = f"{is_loop.sum()} loops and {(~is_loop).sum()} others of {len(pairs)} simulated drives ({worlds})"
    model = LoopModel(alone, f"{source}; benchmarks/quality/fit.py")
    support = np.concatenate([drive.support(model) for drive in pairs])
    terms = {"alone": model.log_odds(evidence), "support": support, "surprise": evidence.surprise}
    tested = {name: terms[name][known] for name in TESTED if name != without}
    return dataclasses.replace(model, tested=fit(tested, is_loop, weights=weights))
