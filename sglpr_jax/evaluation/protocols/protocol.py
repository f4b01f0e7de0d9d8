"""What a protocol is: a published rule that makes one number of what a method says of a recording."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import ScoredPairs, Source, TopK

Kind = Literal["descriptors", "top-k list", "scored top-k list", "scored pairs", "sessions"]
"""What a method hands in: a descriptor file; retrieved frames, without or with scores; pairs of frames with scores;
or descriptor files of several sessions, of which the first is the database."""


@dataclass(frozen=True)
class Protocol:
    """One way to score, by which results of different papers can be compared."""

    name: str
    """As a command line takes it."""
    score: Callable[..., Result]
    """From a source of one of the kinds of `takes` (sessions: several files) and a `seed` to the result."""
    rule: str
    """In words: which answers are right, and what is counted."""
    source: str
    """The publication, with the file of its code that the rule was read from."""
    takes: tuple[Kind, ...]
    returns: Literal["F1max", "recall"]
    """F1max: the highest F1 over all thresholds. Recall: the share of queries with a right answer among the first N."""
    headline: bool = False
    """Whether it is used where no protocol is named."""

    def __call__(self, *sources: Source | ScoredPairs, seed: int = 0) -> Result:
        """Score one source, or several sessions. Raises ValueError where positions are missing."""
        return self.score(*sources, seed=seed)


def kind_of(source: Source | ScoredPairs) -> Kind:
    """Return what `source` is."""
    if isinstance(source, ScoredPairs):
        return "scored pairs"
    if isinstance(source, TopK):
        return "top-k list" if source.scores is None else "scored top-k list"
    return "descriptors"


RETRIEVAL: tuple[Kind, ...] = ("descriptors", "top-k list", "scored top-k list")
"""What a recall can be had from."""
SCORED_RETRIEVAL: tuple[Kind, ...] = ("descriptors", "scored top-k list")
"""What answers with scores can be had from, so that a threshold can accept or reject them."""
