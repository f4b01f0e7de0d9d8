"""Types of a protocol, a published rule that computes one score from the output of a method, and of its result."""

import abc
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int8, Int64

from sglpr_jax.evaluation.protocols.source import Kind, ScoredPairs, Source
from sglpr_jax.metrics import PrecisionRecallCurve

RETRIEVAL: tuple[Kind, ...] = ("descriptors", "top-k list", "scored top-k list")
"""Kinds of input that a recall needs."""
SCORED_RETRIEVAL: tuple[Kind, ...] = ("descriptors", "scored top-k list")
"""Kinds of input with scored answers, which a threshold can accept or reject."""


class Decision(IntEnum):
    """Decision for one frame as a query, at the threshold of F1max."""

    NOT_A_QUERY = 0
    TRUE_POSITIVE = 1
    FALSE_POSITIVE = 2
    FALSE_NEGATIVE = 3
    TRUE_NEGATIVE = 4
    UNCOUNTED = 5
    """Query that the protocol does not count, for example a query answered with a frame 3 to 20 m away."""


@dataclass(frozen=True, eq=False)
class Result:
    """Score of one input by one protocol, with the rule and counts that define it."""

    name: str
    rule: str
    """Rule of the protocol in words, with its distances."""
    dimensions: int | None
    """Dimensions of distances between frames: 2 for x and y, 3 for x, y and z, None if labels were given instead."""
    pose_source: str | None
    """Source of the poses, in words."""
    published_on: str
    """Poses of the published numbers of the protocol. Scores on other poses differ."""
    counts: dict[str, int] = field(default_factory=dict)
    """Numbers of queries and revisits, or of pairs."""
    score: float = np.nan
    """Score, NaN for a sequence without a revisit."""
    interval: tuple[float, float] | None = None
    """95 % bootstrap interval of the score, or None without a score."""
    curve: PrecisionRecallCurve | None = None
    """Curve with negated descriptor distances as thresholds. None for a recall and without a revisit."""
    recalls: dict[int, float] = field(default_factory=dict)
    """Recall@N by N, if the protocol defines it."""
    decisions: Int8[np.ndarray, " n"] | None = None
    """`Decision` of each frame. None for pairs and across sessions."""
    answers: Int64[np.ndarray, " n"] | None = None
    """Answer to each frame, -1 for frames without an answer. None if the protocol applies no threshold."""
    answer_distances: Float64[np.ndarray, " n"] | None = None
    """Descriptor distance of each answer, infinite for frames without an answer."""


@dataclass(frozen=True, kw_only=True)
class Protocol(abc.ABC):
    """Protocol for scoring a method. Subclasses define `__call__`, and their instances the numbers of one paper."""

    name: str
    """Name on the command line."""
    title: str
    """Name of its results."""
    rule: str
    """Rule in words: which answers are right and what is counted."""
    source: str
    """Publication, with the file of its code that defines the rule."""
    published_on: str
    """Poses of the published numbers."""
    dimensions: Literal[2, 3]
    """Dimensions of distances between frames: 2 for x and y, 3 for x, y and z."""
    takes: tuple[Kind, ...]
    """Kinds of input that the protocol accepts."""
    headline: bool = False
    """Whether the protocol is used by default, if no protocol is named."""

    @abc.abstractmethod
    def __call__(self, *sources: Source | ScoredPairs, seed: int = 0) -> Result:
        """Score one source or several sessions. `seed` is that of the bootstrap interval and of drawn pairs.

        Raises ValueError if positions are missing.
        """

    def result(self, rule: str, *sources: Source | ScoredPairs) -> Result:
        """Return a result of these sources without a score. `rule` has the distances in words."""
        poses = ", ".join(dict.fromkeys(source.pose_source for source in sources if source.pose_source)) or None
        return Result(self.title, rule, self.dimensions, poses, self.published_on)
