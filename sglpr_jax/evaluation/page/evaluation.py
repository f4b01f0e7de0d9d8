"""Everything that was found of one method, perhaps with others beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sglpr_jax.evaluation.false_positives import FalsePositive, worst_false_positives
from sglpr_jax.evaluation.protocols import Result


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The results of one method and of those it stands beside, under the same protocols."""

    title: str
    about: str
    """What was compared and how, in a line."""
    methods: Mapping[str, Sequence[Result]]
    """By the name of the method; the first is the one in question."""
    positions: np.ndarray | None
    """(n, 3) float64, metres, z up; None where pairs came with labels alone."""
    published: Sequence[tuple[str, ...]] = ()
    """`report.published_rows` of the sequence, where they were asked for."""

    @property
    def results(self) -> Sequence[Result]:
        """Those of the method in question."""
        return next(iter(self.methods.values()))

    @cached_property
    def judged(self) -> Result | None:
        """The first result that accepts answers by a threshold; None where there is none."""
        return next((result for result in self.results if result.answers is not None), None)

    @cached_property
    def worst(self) -> Sequence[FalsePositive]:
        """The worst false positives of `judged`."""
        if self.judged is None or self.positions is None:
            return []
        return worst_false_positives(self.judged, self.positions)
