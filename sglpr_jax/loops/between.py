"""Loops between two recordings: each stored scan of the second one is compared with the scans of the first one.

Comparison, probability and sequential test are those of a single recording. Scans of both recordings show other places.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import expit, logit

from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.comparison import Candidate, Comparer, Query
from sglpr_jax.loops.config import DetectorConfig, DriftModel
from sglpr_jax.loops.loop import Loop, Rejected, planar_loop
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.loops.sequence import Pair, tested_log_odds, verdict
from sglpr_jax.loops.spectra import query_spectra


def candidates_between(
    queries: CandidateFinder,
    matches: CandidateFinder,
    motion: Motion,
    *,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> list[Candidate]:
    """Find the best match of each stored scan of a recording in another recording.

    Arguments:
      queries: Finder after all scans of the recording whose scans are the queries.
      matches: Finder after all scans of the other recording.
      motion: Motion of both recordings, first that of the matches, in level worlds.
      should_stop: If it returns True, the remaining scans are not compared.
      on_progress: Called with the number of compared scans.

    Returns:
      At most one candidate for each stored scan, in order. Frames are those of `motion`.

    Raises:
      ValueError: If the images of the two recordings have other sizes.
    """
    found: list[Candidate] = []
    if not len(queries.stored) or not len(matches.stored):
        return found
    ours, theirs = (finder.stored.image(0).shape for finder in (queries, matches))
    if ours != theirs:
        raise ValueError(f"expected images of one size in both recordings, found {theirs} and {ours} cells")
    offset = len(matches)
    joined = np.concatenate([finder.joined + start for finder, start in ((matches, 0), (queries, offset))])
    comparer = Comparer(motion, queries.present_drift, np.eye(3), matches.config, matches.verification, joined)
    own = queries.stored.shifted(offset)
    for row, frame in enumerate(queries.stored.frames.tolist()):
        if should_stop():
            break
        image = queries.stored.image(row)
        spectra = query_spectra(image, config=matches.verification)
        query = Query(offset + frame, queries.index.descriptors[row], image, spectra)
        fits = comparer.compare(query, matches.stored, own)
        found += comparer.candidates(query, fits, matches.stored.image_of, possible=fits.frames < offset)
        on_progress(row + 1)
    return found


def probable_loops(
    candidates: Sequence[Candidate],
    model: LoopModel,
    motion: Motion,
    *,
    drift: DriftModel,
    knows_height: bool,
    config: DetectorConfig,
) -> tuple[list[Loop], list[Rejected]]:
    """Loops between two recordings that pass the sequential test, in gravity-aligned frames.

    Arguments:
      candidates: Pairs of `candidates_between`.
      model: Model of the probabilities.
      motion: Motion of both recordings (`Motion.joined`), first that of the matches.
      drift: Drift of the motion.
      knows_height: Whether the odometry measures height.
      config: Thresholds.

    Returns:
      The loops, and the other pairs with the reason for their rejection.
    """
    pairs = []
    for one in candidates:
        probability = float(model.probability(one.evidence))
        loop = planar_loop(one.query, one.match, one.alignment, probability=probability, knows_height=knows_height)
        pairs.append(Pair(loop, one.evidence, float(motion.travelled[one.query])))
    rules = {"mounting": None, "drift": drift, "consistency": config.consistency, "config": config.sequence}
    log_odds = tested_log_odds(pairs, model, motion.path, **rules)
    kept, rejected = [], []
    for pair, value in zip(pairs, log_odds, strict=True):
        if value >= logit(config.min_probability):
            kept.append(dataclasses.replace(pair.loop, probability=float(expit(value))))
        else:
            rejected.append(Rejected(pair.loop, verdict(pair, model, config.min_probability)))
    return kept, rejected
