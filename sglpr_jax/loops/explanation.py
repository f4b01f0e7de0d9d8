"""Explanations for the user: why a recording has no loops."""

from sglpr_jax.loops.find import FoundLoops
from sglpr_jax.loops.reasons import MEANING, counted


def why_none(found: FoundLoops) -> list[str]:
    """Reasons why a recording has no loops, one sentence each. Empty if there are loops."""
    if found.loops:
        return []
    if not found.frames:
        return ["The search was stopped before the first scan."]
    reasons = []
    if found.frames < len(found.recording):
        reasons.append(f"The search was stopped after {found.frames} of {len(found.recording)} frames.")
    if 2 * found.empty > found.frames:
        cells = found.config.candidates.min_cells
        reasons.append(
            f"{found.empty} of {found.frames} scans are almost empty (fewer than {cells} occupied cells of the image): "
            "check the format and the range of the points, and whether the sensor was covered."
        )
    if 2 * len(found.skipped) > found.frames:
        reasons.append(f"{len(found.skipped)} of {found.frames} scans cannot be read.")
    return [*reasons, _of_pairs(found)]


def _of_pairs(found: FoundLoops) -> str:
    """Most frequent reason why the compared pairs are not loops."""
    if not found.rejected:
        source = "images" if found.odometry is None else "odometry"
        return (
            f"No pair was compared: according to the {source}, no scan came back to a place after at least "
            f"{found.config.candidates.recent_m:g} m of travelled distance."
        )
    reason, count = next(iter(counted(found.rejected).items()))
    return f"{len(found.rejected)} pairs were compared. For {count} of them: {MEANING[reason]}"
