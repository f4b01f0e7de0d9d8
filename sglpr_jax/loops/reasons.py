"""Reasons for the rejection of pairs: meanings and counts."""

from collections import Counter
from collections.abc import Sequence

from sglpr_jax.loops.loop import DEGENERATE_M, Reason, Rejected

MEANING: dict[Reason, str] = {
    "little similarity": "The images fit too little, or the motion makes the pose improbable.",
    "repeats": "Another place, or another pose, fits about as well.",
    "too few neighbours": "Too few of the frames before and after the query show the same place.",
    "contradicts the motion": "The motion between the two frames, estimated from their images, leads elsewhere.",
    "contradicts the odometry": "The loop needs more drift of the odometry than was stated.",
    "contradicts other loops": "The loop is not consistent with the largest set of loops that agree.",
    "little overlap": "The two scans, registered in 6 degrees of freedom, overlap too little.",
    "degenerate": f"The position is uncertain by more than {DEGENERATE_M:g} m along one direction, as between walls.",
}
"""Meaning of each reason, one sentence each."""


def counted(rejected: Sequence[Rejected]) -> dict[Reason, int]:
    """Number of rejected pairs by reason, the most frequent reason first."""
    reasons: list[Reason] = [one.reason for one in rejected]
    return dict(Counter(reasons).most_common())


def listed(counts: dict[Reason, int]) -> str:
    """Format counts in one line: "repeats: 10, little overlap: 2"."""
    return ", ".join(f"{reason}: {count}" for reason, count in counts.items())


def why_rejected(rejected: Sequence[Rejected]) -> list[str]:
    """Lines for the user: one for each reason, with its count and meaning."""
    return [f"rejected, {reason} ({count}): {MEANING[reason]}" for reason, count in counted(rejected).items()]
