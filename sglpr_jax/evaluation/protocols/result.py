"""What a protocol returns: a number, and all that says what the number is."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from jaxtyping import Float64, Int8, Int64

from sglpr_jax.metrics import PrecisionRecallCurve


class Decision(IntEnum):
    """What became of one frame as a query, at the threshold of F1max."""

    NOT_A_QUERY = 0
    TRUE_POSITIVE = 1
    FALSE_POSITIVE = 2
    FALSE_NEGATIVE = 3
    TRUE_NEGATIVE = 4
    UNCOUNTED = 5
    """A query that the protocol counts for nothing, such as one answered with a frame 3 to 20 m away."""


@dataclass(frozen=True, eq=False)
class Result:
    """One protocol's number for one descriptor file, with all that says what the number is."""

    name: str
    rule: str
    """The protocol in words, with its distances."""
    dimensions: int | None
    """2: distances in x and y. 3: in x, y and z. None: no distances, the truth was given."""
    pose_source: str | None
    published_on: str
    """The poses that the protocol's published numbers rest on: on others its number is another one."""
    counts: dict[str, int] = field(default_factory=dict)
    """What the score rests on: queries and revisits, or pairs."""
    score: float = np.nan
    """NaN where the sequence has no revisit, so that there is nothing to find."""
    interval: tuple[float, float] | None = None
    """The 95 % bootstrap interval of the score; None where there is no score."""
    curve: PrecisionRecallCurve | None = None
    """Its thresholds are negated descriptor distances. None for a recall, and where there is no revisit."""
    recalls: dict[int, float] = field(default_factory=dict)
    """Recall@N by N, where the protocol has it."""
    decisions: Int8[np.ndarray, " n"] | None = None
    """A `Decision` for every frame. None for pairs and across sessions."""
    answers: Int64[np.ndarray, " n"] | None = None
    """The frame that each query was answered with, -1 elsewhere. None where answers meet no threshold."""
    answer_distances: Float64[np.ndarray, " n"] | None = None
    """The descriptor distances of `answers`, infinite where there is none."""
