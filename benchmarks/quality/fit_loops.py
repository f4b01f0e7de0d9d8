"""Fits the model of loops that ships with the package: how probable it is that two scans show one place.

    python -m benchmarks repeating render --seeds 1 --out build/fit
    python -m benchmarks repeating fit build/fit

Every drive is searched without odometry, once as it is and once with a break of the motion in its middle, and every
third drive with odometry that drifts. All kinds of drives count alike. A pair is a loop by
`scoring.PoseErrors`. Each scenery is judged by a model that was fitted to the others.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table
from scipy.special import expit

import sglpr_jax
from benchmarks.drives import Odometry
from benchmarks.quality.repeating import compared, read
from benchmarks.quality.scoring import STOREY_M, pose_errors
from sglpr_jax.files import write_json
from sglpr_jax.loops.calibration import calibration_error, reliability
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.closure import planar_loop
from sglpr_jax.loops.consistency import are_consistent
from sglpr_jax.loops.probability import ALL, DEFAULT, TESTED, Evidence, LoopModel, fit
from sglpr_jax.loops.sequence import neighbour_weights
from sglpr_jax.models.params import Params
from sglpr_jax.se3 import transform

PAIRS = 300.0
"""The drives of a scenery with one kind of revisits and odometry count as this number of pairs."""
DRIFTING = 3
"""One of this number of drives is also searched with odometry."""
SURE = 0.99


class Pairs(NamedTuple):
    """Candidates of one drive that the motion allows."""

    evidence: Evidence
    """Evidence of each pair alone."""
    neighbours: Float[np.ndarray, "n n"]
    """Weight of each pair as neighbour of another one, negative if they disagree."""
    is_loop: Bool[np.ndarray, " n"]
    is_known: Bool[np.ndarray, " n"]
    """Whether a pair is certainly a loop or certainly none."""

    def log_odds(self, model: LoopModel) -> Float[np.ndarray, " n"]:
        """Log odds of each pair, with its neighbours."""
        return model.tested_log_odds(self.evidence, self.support(model))

    def support(self, model: LoopModel) -> Float[np.ndarray, " n"]:
        """What the neighbours of each pair say, by their evidence alone."""
        return self.neighbours @ model.strength(self.evidence)


def fit_model(
    drives: tyro.conf.Positional[Path],
    *,
    weights: str = "sglpr",
    without_each: bool = False,
    out: Path = DEFAULT,
) -> None:
    """Fit and write the model.

    The table has the pairs of each scenery, with neighbours and alone, the share of right pairs above two
    probabilities, the wrong pairs, and the expected calibration error.

    Args:
        drives: folder of `repeating render`.
        weights: the model that describes the scans.
        without_each: also judge models without each term.
        out: the file to write.
    """
    files = sorted(drives.glob("*.npz"))
    works: list[tuple[Path, Odometry, bool]] = [(path, "none", broken) for broken in (False, True) for path in files]
    works += [(path, "drifting", False) for path in files[::DRIFTING]]
    params = sglpr_jax.load(weights)
    found = [_pairs(*work, params) for work in works]
    sceneries = [path.stem.split("-")[0] for path, _, _ in works]
    kinds = ["-".join([*path.stem.split("-")[:2], odometry]) for path, odometry, _ in works]
    table = Table("scenery", "right", f">= {SURE}", ">= 0.5", "wrong", f">= {SURE}", ">= 0.5", "ECE")
    judged = held_out(found, sceneries, kinds)
    for scenery, (probability, alone, is_loop) in judged.items():
        table.add_row(scenery, *_row(probability, is_loop))
        table.add_row(f"{scenery}, alone", *_row(alone, is_loop))
    probability, is_loop = _whole(judged)
    table.add_row("all", *_row(probability, is_loop))
    for name in (*ALL, "support") if without_each else ():
        table.add_row(f"without {name}", *_row(*_whole(held_out(found, sceneries, kinds, without=name))))
    Console().print(table)
    for one in reliability(probability, is_loop):
        print(
            f"{one.low:.2f} to {one.high:.2f}: {one.pairs} pairs, said {one.probability:.3f}, {one.share:.3f} are loops"
        )
    everything = fitted(found, kinds)
    write_json(out, everything.to_json())
    print(everything)


class Judged(NamedTuple):
    """Pairs that are certainly loops or certainly none, judged by a model of other sceneries."""

    probability: Float[np.ndarray, " n"]
    """With neighbours."""
    alone: Float[np.ndarray, " n"]
    """Without neighbours."""
    is_loop: Bool[np.ndarray, " n"]


def held_out(
    found: Sequence[Pairs], sceneries: Sequence[str], kinds: Sequence[str], *, without: str | None = None
) -> dict[str, Judged]:
    """Judge each scenery by a model that was fitted to the others, or by one that lacks a term."""
    judged = {}
    for scenery in dict.fromkeys(sceneries):
        others = [row for row, one in enumerate(sceneries) if one != scenery]
        model = fitted([found[row] for row in others], [kinds[row] for row in others], without=without)
        own = [found[row] for row, one in enumerate(sceneries) if one == scenery]
        chosen = np.concatenate([one.is_known for one in own])
        log_odds = [one.log_odds(model) for one in own], [model.log_odds(one.evidence) for one in own]
        tested, alone = (expit(np.concatenate(values)[chosen]) for values in log_odds)
        judged[scenery] = Judged(tested, alone, np.concatenate([one.is_loop for one in own])[chosen])
    return judged


def _whole(judged: Mapping[str, Judged]) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    return tuple(np.concatenate(values) for values in zip(*((p, ok) for p, _, ok in judged.values()), strict=True))


def _row(probability: Float[np.ndarray, " n"], is_loop: Bool[np.ndarray, " n"]) -> list[str]:
    """Counts of right and wrong pairs, the shares of the right and the numbers of the wrong ones above limits, and the
    expected calibration error."""
    right, wrong = probability[is_loop], probability[~is_loop]
    shares = [f"{(right >= limit).mean():.2f}" if len(right) else "" for limit in (SURE, 0.5)]
    error = f"{calibration_error(reliability(probability, is_loop)):.3f}"
    return [str(len(right)), *shares, str(len(wrong)), *(str((wrong >= limit).sum()) for limit in (SURE, 0.5)), error]


def fitted(found: Sequence[Pairs], kinds: Sequence[str], *, without: str | None = None) -> LoopModel:
    """Model of some drives, of which each kind counts alike. It may lack one term."""
    counts = Counter[str]()
    for kind, one in zip(kinds, found, strict=True):
        counts[kind] += int(one.is_known.sum())
    each = zip(kinds, found, strict=True)
    weights = np.concatenate([np.full(one.is_known.sum(), PAIRS / max(counts[kind], 1)) for kind, one in each])
    evidence = Evidence(*map(np.concatenate, zip(*(one.evidence for one in found), strict=True)))
    known = np.concatenate([one.is_known for one in found])
    is_loop = np.concatenate([one.is_loop for one in found])[known]
    terms = {name: values[known] for name, values in evidence._asdict().items() if name != without}
    alone = fit(terms, is_loop, weights=weights)
    sceneries = ", ".join(dict.fromkeys(kind.split("-")[0] for kind in kinds))
    about = f"{is_loop.sum()} loops and {(~is_loop).sum()} others of {len(found)} simulated drives ({sceneries})"
    model = LoopModel(alone, f"{about}; benchmarks/quality/fit_loops.py")
    support = np.concatenate([one.support(model) for one in found])
    values = {"alone": model.log_odds(evidence), "support": support, "surprise": evidence.surprise}
    tested = {name: values[name][known] for name in TESTED if name != without}
    return dataclasses.replace(model, tested=fit(tested, is_loop, weights=weights))


def _pairs(path: Path, odometry: Odometry, breaks: bool, params: Params) -> Pairs:
    """The candidates of one drive that the motion allows. With `breaks`, the motion is unknown in the middle."""
    drive, finder = read(path), CandidateSearch(params)
    frames = compared(path, drive, params, odometry=odometry, breaks=breaks)
    poses, found = drive.odometry(odometry), []
    for i, (seen, frame) in enumerate(zip(drive.seen, frames, strict=True)):
        pose = None if poses is None else poses[i]
        continues = not (breaks and i == len(frames) // 2)
        found += finder.add_keyframe(seen, time=float(drive.times[i]), odometry=pose, fits=frame, continues=continues)
    found = [one for one in found if one.evidence.deviation <= finder.present_drift.max_deviation]
    fits = [transform(*(float(value) for value in one.alignment[:3])) for one in found]
    errors = pose_errors([(one.query, one.match) for one in found], np.array(fits), drive.world_from_lidar)
    evidence = np.array([one.evidence for one in found], np.float64).reshape(-1, len(ALL))
    loops = [planar_loop(one.query, one.match, one.alignment, probability=0.5) for one in found]
    way_m = np.maximum.accumulate([float(finder.motion.travelled[one.query]) for one in found])
    agreeing = are_consistent(loops, finder.motion.path, drift=finder.present_drift)
    neighbours = neighbour_weights(way_m, np.arange(len(found))) * np.where(agreeing, 1.0, -1.0)
    wrong = errors.wrong if odometry != "none" else errors.wrong & (errors.storey_m <= STOREY_M)
    return Pairs(Evidence(*evidence.T), neighbours, errors.right, errors.right | wrong)
