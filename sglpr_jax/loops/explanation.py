"""Explanations for the user: why a recording has no loops."""

import numpy as np

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.times import FASTEST_S
from sglpr_jax.loops.config import CandidateConfig
from sglpr_jax.loops.find import FoundLoops
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.reasons import counted, listed


def why_none(found: FoundLoops) -> list[str]:
    """Reasons why a recording has no loops, one sentence each. Empty if there are loops."""
    if found.loops:
        return []
    if not found.frames:
        return ["The search was stopped before the first scan."]
    reasons = []
    if found.frames < len(found.recording):
        reasons.append(f"The search was stopped after {found.frames} of {len(found.recording)} frames.")
    too_recent = why_few_queries(found.recording, found.config.candidates, frames=found.frames)
    reasons += [] if too_recent is None else [too_recent]
    if 2 * found.empty > found.frames:
        cells = found.config.candidates.min_cells
        reasons.append(
            f"{found.empty} of {found.frames} scans are almost empty (fewer than {cells} occupied cells of the image): "
            "check the format and the range of the points, and whether the sensor was covered."
        )
    if 2 * len(found.skipped) > found.frames:
        reasons.append(f"{len(found.skipped)} of {found.frames} scans cannot be read.")
    return [*reasons, *_of_pairs(found, alone=not reasons)]


def why_few_queries(recording: Recording, rules: CandidateConfig, *, frames: int | None = None) -> str | None:
    """Why fewer than half of the frames have an earlier frame that is old enough to be a match. Otherwise None.

    Arguments:
      recording: The scans. Only number and times are used.
      rules: Minimum age of a match.
      frames: Number of searched frames, by default all.
    """
    frames = len(recording) if frames is None else frames
    queries = _queries(recording, rules, frames)
    if 2 * queries >= frames:
        return None
    some = f" Only {queries} of {frames} frames have a frame old enough to be compared with." if queries else ""
    if recording.times is None:
        return (
            f"{frames} frames without times: pairs less than {rules.exclude_frames} frames apart are not considered; "
            f"give --times.{some}"
        )
    times = recording.times[:frames]
    lasts, steps = float(times[-1] - times[0]), np.diff(times)
    if frames > 1 and not lasts:
        return f"The times do not advance: all {frames} frames have the time {times[0]:.12g} s; give --times."
    standing = int((steps == 0).sum())
    about = f" ({standing} of {len(steps)} times do not advance)" if 2 * standing > len(steps) else ""
    unit = " Times are expected in seconds." if lasts < FASTEST_S * len(steps) else ""
    return (
        f"The recording lasts {lasts:.3g} s{about}: pairs less than {rules.exclude_s:g} s apart are not considered."
        f"{unit}{some}"
    )


def _queries(recording: Recording, rules: CandidateConfig, frames: int) -> int:
    """Number of frames that have an earlier frame that is old enough."""
    if recording.times is None:
        return max(frames - 1 - rules.exclude_frames, 0)
    times = recording.times[:frames]
    return int((times[1:] - times[0] >= rules.exclude_s).sum())


def _of_pairs(found: FoundLoops, *, alone: bool) -> list[str]:
    """Reasons why the compared pairs are not loops. With `alone`, there is no other reason."""
    if found.rejected:
        pairs = len(found.rejected)
        return [f"{pairs} pairs looked like loops, and all were rejected ({listed(counted(found.rejected))})."]
    if not found.candidates:
        return [_nothing_compared(found)] if alone else []
    compared = f"{len(found.candidates)} pairs were compared"
    if found.model is None:
        return [f"{compared}, and none is similar enough."]
    best = float(found.model.probability(Evidence.stack([one.evidence for one in found.candidates])).max())
    if best < found.config.min_probability:
        return [f"{compared}, and none is similar enough: the highest probability is {best:.3g}."]
    return [f"{compared}; some are probable, but too few frames before and after them show the same place."]


def _nothing_compared(found: FoundLoops) -> str:
    rules = found.config
    if found.odometry is None:
        return (
            "No pair was compared: according to the images, the sensor moved less than "
            f"{rules.candidates.min_travelled_m:g} m after the frames that are old enough."
        )
    return (
        "No pair was compared: according to the odometry, no earlier frame is near enough (within "
        f"{rules.drift.max_deviation:g} sigmas of drift, {rules.drift}) and at least "
        f"{rules.candidates.min_travelled_m:g} m of travelled distance before the query."
    )
