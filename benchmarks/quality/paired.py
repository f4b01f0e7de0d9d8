"""Whether one way of training is better than another: several seeds of each, paired query by query and seed by seed.

    python -m benchmarks.quality.paired --ours on1/06.npz on2/06.npz --others off1/06.npz off2/06.npz

Seed by seed the two describe the same frames, so every resample of the queries is the same for both, and what is left
in the difference is the difference.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

import sglpr_jax
from sglpr_jax.evaluation.protocols.bootstrap import interval, resampled_f1_max
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.scoring import evaluate
from sglpr_jax.revisits import database_end, has_near
from sglpr_jax.same_place import NEGATIVE_M, POSITIVE_M

PROTOCOLS = ("top1-f1max", "pairs-f1max", "bevplace-recall-at-1")


def main(*, ours: tuple[Path, ...], others: tuple[Path, ...], title: str = "") -> None:
    """Print the mean of each protocol over the seeds, the range of its differences, and top-1's with an interval.

    Args:
        ours: descriptor files of one recording, a seed each.
        others: those of the other way, in the same order of seeds.
        title: of the table.
    """
    if len(ours) != len(others):
        raise SystemExit(f"expected as many files of both, found {len(ours)} and {len(others)}")
    left, right = ([evaluate(path, PROTOCOLS).results for path in paths] for paths in (ours, others))
    table = Table("protocol", "ours", "others", "difference", "of each seed", "95 %", title=title)
    for number, name in enumerate(PROTOCOLS):
        scores = np.array([[results[number].score for results in side] for side in (left, right)])
        if np.isnan(scores).any():
            continue
        each = scores[0] - scores[1]
        whole = paired_interval(ours, left, others, right) if number == 0 else None
        table.add_row(
            name,
            *(f"{score:.3f}" for score in scores.mean(axis=1)),
            f"{each.mean():+.4f}",
            " ".join(f"{one:+.3f}" for one in each),
            "" if whole is None else f"{whole[0]:+.4f} to {whole[1]:+.4f}",
        )
    Console(width=110).print(table)


def paired_interval(
    ours: Sequence[Path], left: Sequence[Sequence[Result]], others: Sequence[Path], right: Sequence[Sequence[Result]]
) -> tuple[float, float]:
    """Of the mean difference of top-1 F1max, over resamples of the queries."""
    differences = [
        resampled(one, results[0]) - resampled(other, against[0])
        for one, results, other, against in zip(ours, left, others, right, strict=True)
    ]
    return interval(np.mean(differences, axis=0))


def resampled(path: Path, result: Result) -> Float[np.ndarray, " resamples"]:
    """Top-1 F1max in every resample of the queries."""
    file = sglpr_jax.DescriptorFile.load(path)
    positions, answers, distances = file.positions, result.answers, result.answer_distances
    assert positions is not None and answers is not None and distances is not None
    ends = database_end(len(file), times=file.times)
    queries = np.flatnonzero(ends)
    apart = np.linalg.norm(positions[queries] - positions[answers[queries]], axis=1)
    answered = answers[queries] >= 0
    return resampled_f1_max(
        -distances[queries],
        true_if_accepted=answered & (apart <= POSITIVE_M),
        false_if_accepted=answered & (apart > NEGATIVE_M),
        missed_if_rejected=has_near(positions[queries], positions, ends[queries], lambda apart: apart <= POSITIVE_M),
        query=queries,
        seed=0,
    )


if __name__ == "__main__":
    tyro.cli(main)
