"""What every method scores on every drive, the numbers in the tables."""

import functools

from sglpr_jax.cli.reproduction.experiments import VARIANTS
from sglpr_jax.cli.reproduction.runs import Runs
from sglpr_jax.evaluation.protocols import Result, top1_f1max


@functools.cache
def top1(runs: Runs, method: str, seq: str, *, rotated: bool = False) -> Result:
    """The paper's F1max (3 m / 20 m, top-1) of a variant or of a method without training."""
    describe = runs.descriptors if method in VARIANTS else runs.baseline
    return top1_f1max(describe(method, seq, rotated=rotated))
