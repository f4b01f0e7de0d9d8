"""Protocols in plain loops, to compare the fast ones with."""

from collections.abc import Callable, Iterable

import numpy as np

from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def random_drive(seed, n=60):
    """A recording in which frames are often 0 to 30 m from older ones; descriptors that know only part of it."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-15, 15, (n, 3)) * [1, 1, 0.2]
    descriptors = (positions + rng.normal(scale=4, size=(n, 3))) @ rng.normal(size=(3, 8)) / 20
    return positions, descriptors.astype(np.float32), np.sort(rng.uniform(0, 120, n))


def distance(a, b):
    return float(np.linalg.norm(a - b))


def f1_max(thresholds, count):
    """The highest F1 over (tp, fp, fn) counted at every threshold."""
    return max((2 * tp / (2 * tp + fp + fn) if tp else 0.0) for tp, fp, fn in map(count, thresholds))


def ranked(file: DescriptorFile, query: int, database: Iterable[int]) -> list[int]:
    """The database, the nearest descriptor first."""
    return sorted(database, key=lambda i: distance(file.descriptors[query], file.descriptors[i]))


def top1(
    file: DescriptorFile, databases: dict[int, range], right: Callable[[int, int], bool]
) -> tuple[float, int, float]:
    """F1max, revisits and Recall@1 where every accepted answer that is not right is false."""
    answers = []
    for query, database in databases.items():
        best = ranked(file, query, database)[0]
        score = distance(file.descriptors[query], file.descriptors[best])
        answers.append((score, right(query, best), any(right(query, i) for i in database)))

    def count(threshold):
        accepted = [hit for score, hit, _ in answers if score <= threshold]
        missed = [revisit for score, _, revisit in answers if score > threshold]
        return sum(accepted), len(accepted) - sum(accepted), sum(missed)

    revisits = sum(revisit for _, _, revisit in answers)
    found = sum(hit and revisit for _, hit, revisit in answers)
    return f1_max([score for score, _, _ in answers], count), revisits, found / revisits


def recall(file: DescriptorFile, databases: dict[int, range], right: Callable[[int, int], bool], n: int) -> float:
    """Recall@n over the queries with something to find."""
    found = []
    for query, database in databases.items():
        if any(right(query, i) for i in database):
            found.append(any(right(query, i) for i in ranked(file, query, database)[:n]))
    return sum(found) / len(found)
