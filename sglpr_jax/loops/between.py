"""Loops between two recordings: each stored scan of the second one is compared with the scans of the first one.

Probability and sequential test are those of a single recording. The rivals of a pair come from both recordings.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import expit, logit

from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.compared_image import occupied
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.loop import Loop, Rejected, planar_loop
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.planar import frames_of
from sglpr_jax.loops.probability import Evidence, LoopModel
from sglpr_jax.loops.rivals import distance_share, expected_poses, rival_share, rivals_around
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.sequence import added_log_odds, agree_in_motion
from sglpr_jax.loops.spectra import query_spectra
from sglpr_jax.loops.transforms import transform
from sglpr_jax.loops.verification import refined

BLOCK = 64
"""Number of loops that pass the sequential test at a time, to limit memory."""


def candidates_between(
    queries: CandidateFinder,
    matches: CandidateFinder,
    *,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> list[Candidate]:
    """Find the best match of each stored scan of a recording in another recording.

    Arguments:
      queries: Finder after all scans of the recording whose scans are the queries.
      matches: Finder after all scans of the other recording.
      should_stop: If it returns True, the remaining scans are not compared.
      on_progress: Called with the number of compared scans.

    Returns:
      At most one candidate for each stored scan, in order. Frames are those of the two recordings.

    Raises:
      ValueError: If the images of the two recordings have other sizes.
    """
    found: list[Candidate] = []
    if not len(queries.stored) or not len(matches.stored):
        return found
    ours, theirs = (finder.stored.image(0).shape for finder in (queries, matches))
    if ours != theirs:
        raise ValueError(f"expected images of one size in both recordings, found {theirs} and {ours} cells")
    for row in range(len(queries.stored)):
        if should_stop():
            break
        found += _candidates(queries, matches, row)
        on_progress(row + 1)
    return found


def _candidates(queries: CandidateFinder, matches: CandidateFinder, row: int) -> list[Candidate]:
    """The best match of the stored scan `row`, or an empty list."""
    config, stored = matches.config, matches.stored
    seen = Seen(queries.index.descriptors[row], queries.stored.image(row), None)
    spectra, none = query_spectra(seen.image, config=matches.verification), np.zeros(len(stored), bool)
    compared, peaks = matches.comparer.compared(seen.descriptor, spectra, none, fit=matches.comparer.fit)
    if not len(compared) or peaks.correlation.max() < config.min_correlation:
        return []
    best = int(np.argmax(peaks.correlation))
    peak, match_row = peaks.one(best), int(compared[best])
    query, match = int(queries.stored.frames[row]), int(stored.frames[match_row])
    image = stored.image(match_row)
    alignment = jax.device_get(refined(seen.image, image, peak, config=matches.verification))
    distance = float(np.linalg.norm(matches.index.descriptors[match_row] - seen.descriptor))
    shares = np.nan, np.nan
    rules, correlation = config.rivals, float(peak.correlation)
    known = (
        (matches, match, rules.of_match, transform(float(peak.x), float(peak.y), float(peak.yaw))),
        (queries, query, rules.of_query, np.eye(4)),
    )
    for finder, frame, count, frame_from_query in known:
        frames, descriptors = finder.stored.frames, finder.index.descriptors
        about = {"count": count, "exclude_s": config.exclude_s, "config": rules}
        rows = rivals_around(seen.descriptor, descriptors, frames, frame, finder.motion, **about)
        found = matches.comparer.search(spectra, finder.stored.spectra(rows))
        expected = [expected_poses(finder.motion, frame, frames[rows], frame_from_query, config=rules)]
        apart = np.linalg.norm(descriptors[rows] - seen.descriptor, axis=1)
        here = distance_share(distance, apart, expected, config=rules)
        shares = np.fmax(shares, (here, rival_share(found, correlation, expected, config=rules)))
    far = ~matches.comparer.about(match_row)[compared] & matches.motion.same(match, stored.frames[compared])
    shares = np.fmax(shares, matches.comparer.shares(seen, match, distance, peak, compared[far], peaks.some(far), []))
    cells = min(occupied(one, matches.verification) for one in (seen.image, image))
    evidence = Evidence.of(distance, shares[0], alignment.correlation, alignment.second, shares[1], cells)
    return [Candidate(query, match, alignment, evidence)]


def probable_loops(
    candidates: Sequence[Candidate], model: LoopModel, motion: Motion, *, offset: int, config: DetectorConfig
) -> tuple[list[Loop], list[Rejected]]:
    """Loops between two recordings that pass the sequential test, in gravity-aligned frames.

    Arguments:
      candidates: Pairs of `candidates_between`.
      model: Model of the probabilities.
      motion: Motion of both recordings (`Motion.joined`), first that of the matches.
      offset: Number of frames of the recording of the matches. It is added to the frames of the queries.
      config: Thresholds.

    Returns:
      The loops, and the pairs that looked like loops. Frames are those of `motion`.
    """
    least, rejected = min(config.sequence.least_probability, config.min_probability), []
    loops, log_odds = [], []
    for one in candidates:
        odds = float(model.log_odds(one.evidence))
        loop = planar_loop(offset + one.query, one.match, one.alignment, probability=float(expit(odds)))
        if odds >= logit(least):
            loops.append(loop)
            log_odds.append(odds)
        elif model.but_for_repetition(one.evidence) >= logit(config.min_probability):
            rejected.append(Rejected(loop, "repeats"))
    tested, supported = _with_neighbours(loops, np.array(log_odds), motion, config)
    enough = supported & (tested >= logit(config.min_probability))
    kept = [
        dataclasses.replace(loop, probability=float(expit(odds)))
        for loop, odds, fits in zip(loops, tested, enough, strict=True)
        if fits
    ]
    alone = [
        Rejected(loop, "too few neighbours")
        for loop, fits in zip(loops, enough, strict=True)
        if not fits and loop.probability >= config.min_probability
    ]
    return kept, sorted([*rejected, *alone], key=lambda one: one.loop.query)


def _with_neighbours(
    loops: Sequence[Loop], log_odds: Float[np.ndarray, " n"], motion: Motion, config: DetectorConfig
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Log odds of each loop given its neighbours, and whether enough neighbours agree with it."""
    rules, (query, _) = config.sequence, frames_of(loops)
    tested, supported = log_odds.copy(), np.zeros(len(loops), bool)
    for start in range(0, len(loops), BLOCK):
        own = slice(start, min(start + BLOCK, len(loops)))
        first = int(np.searchsorted(query, query[own][0] - rules.frames))
        end = int(np.searchsorted(query, query[own][-1] + rules.frames, side="right"))
        some, inner = list(loops[first:end]), slice(own.start - first, own.stop - first)
        near = np.abs(query[first:end, None] - query[None, first:end]) <= rules.frames
        agreeing = agree_in_motion(some, motion, None, config=rules) & near
        tested[own] = added_log_odds(some, log_odds[first:end], agreeing, motion, config=rules)[inner]
        supported[own] = agreeing.sum(axis=1)[inner] >= rules.support
    return tested, supported
