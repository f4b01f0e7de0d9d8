"""Type of a protocol: a published rule that computes one score from the output of a method."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import ScoredPairs, Source, TopK

Kind = Literal["descriptors", "top-k list", "scored top-k list", "scored pairs", "sessions"]
"""Kind of input: a descriptor file, retrieved frames without or with scores, pairs of frames with scores, or descriptor
files of several sessions. The first session is the database."""


@dataclass(frozen=True)
class Protocol:
    """Protocol for scoring a method."""

    name: str
    """Name on the command line."""
    score: Callable[..., Result]
    """Function of a source (several files for sessions) and a `seed` that returns the result."""
    rule: str
    """Rule in words: which answers are right and what is counted."""
    source: str
    """Publication, with the file of its code that defines the rule."""
    takes: tuple[Kind, ...]
    """Kinds of input that the protocol accepts."""
    returns: Literal["F1max", "recall"]
    """Score: the highest F1 over all thresholds, or the share of queries with a right answer among the first N."""
    headline: bool = False
    """Whether the protocol is used by default, if no protocol is named."""

    def __call__(self, *sources: Source | ScoredPairs, seed: int = 0) -> Result:
        """Score one source or several sessions. Raises ValueError if positions are missing."""
        return self.score(*sources, seed=seed)


def kind_of(source: Source | ScoredPairs) -> Kind:
    """Return the kind of `source`."""
    if isinstance(source, ScoredPairs):
        return "scored pairs"
    if isinstance(source, TopK):
        return "top-k list" if source.scores is None else "scored top-k list"
    return "descriptors"


RETRIEVAL: tuple[Kind, ...] = ("descriptors", "top-k list", "scored top-k list")
"""Kinds of input that a recall needs."""
SCORED_RETRIEVAL: tuple[Kind, ...] = ("descriptors", "scored top-k list")
"""Kinds of input with scored answers, which a threshold can accept or reject."""
