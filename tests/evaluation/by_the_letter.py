"""Protocols in plain loops, to compare the fast ones with."""

from collections.abc import Callable, Iterable

import numpy as np

from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def random_drive(seed, n=60):
    """Return positions, noisy descriptors and times of a recording with frames 0 to 30 m from older ones."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-15, 15, (n, 3)) * [1, 1, 0.2]
    descriptors = (positions + rng.normal(scale=4, size=(n, 3))) @ rng.normal(size=(3, 8)) / 20
    return positions, descriptors.astype(np.float32), np.sort(rng.uniform(0, 120, n))


def distance(a, b):
    return float(np.linalg.norm(a - b))


def f1_max(thresholds, count):
    """Return the highest F1 over all thresholds. `count` returns (tp, fp, fn) of a threshold."""
    return max((2 * tp / (2 * tp + fp + fn) if tp else 0.0) for tp, fp, fn in map(count, thresholds))


def within(file: DescriptorFile, metres: float, dimensions: int, *, closed: bool = False) -> Callable[[int, int], bool]:
    positions = file.positions[:, :dimensions]

    def right(i, j):
        apart = distance(positions[i], positions[j])
        return apart <= metres if closed else apart < metres

    return right


def ranked(file: DescriptorFile, query: int, database: Iterable[int]) -> list[int]:
    """Return the frames of the database, nearest descriptor first."""
    return sorted(database, key=lambda i: distance(file.descriptors[query], file.descriptors[i]))


def top1(
    file: DescriptorFile,
    databases: dict[int, range],
    right: Callable[[int, int], bool],
    wrong: Callable[[int, int], bool] | None = None,
) -> tuple[float, int, float]:
    """Return F1max, number of revisits and Recall@1. Without `wrong`, every answer that is not right is wrong."""
    answers = []
    for query, database in databases.items():
        best = ranked(file, query, database)[0]
        score = distance(file.descriptors[query], file.descriptors[best])
        hit = right(query, best)
        false = wrong(query, best) if wrong else not hit
        answers.append((score, hit, false, any(right(query, i) for i in database)))

    def count(threshold):
        accepted = [(hit, false) for score, hit, false, _ in answers if score <= threshold]
        missed = [revisit for score, _, _, revisit in answers if score > threshold]
        return sum(hit for hit, _ in accepted), sum(false for _, false in accepted), sum(missed)

    revisits = sum(revisit for *_, revisit in answers)
    found = sum(hit and revisit for _, hit, _, revisit in answers)
    return f1_max([score for score, *_ in answers], count), revisits, found / revisits if revisits else np.nan


def pairs(
    file: DescriptorFile, positive: Callable[[float, int], bool], first_gap: int = 1
) -> tuple[float, dict[str, int]]:
    """Return F1max over pairs with all negatives (beyond 20 m), and the numbers of positive and negative pairs."""
    p, d = file.positions[:, :2], file.descriptors
    every = [(i, j) for i in range(len(file)) for j in range(i + 1 - first_gap)]
    right = [distance(d[i], d[j]) for i, j in every if positive(distance(p[i], p[j]), i - j)]
    wrong = [distance(d[i], d[j]) for i, j in every if distance(p[i], p[j]) > 20]

    def count(threshold):
        tp = sum(x <= threshold for x in right)
        return tp, sum(x <= threshold for x in wrong), len(right) - tp

    counts = {"positive pairs": len(right), "negative pairs": len(wrong)}
    return f1_max(right, count) if right else np.nan, counts


def recall(file: DescriptorFile, databases: dict[int, range], right: Callable[[int, int], bool], n: int) -> float:
    """Return Recall@n over the queries with a right answer in their database."""
    found = []
    for query, database in databases.items():
        if any(right(query, i) for i in database):
            found.append(any(right(query, i) for i in ranked(file, query, database)[:n]))
    return sum(found) / len(found)


def recall_across(database: DescriptorFile, queries: DescriptorFile, metres: float, n: int) -> tuple[float, int]:
    """Return Recall@n of one session in another, and the number of queries with a right answer there."""
    found = []
    for position, descriptor in zip(queries.positions, queries.descriptors, strict=True):
        near = [distance(position[:2], p[:2]) < metres for p in database.positions]
        order = np.argsort([distance(descriptor, d) for d in database.descriptors])
        if any(near):
            found.append(any(near[i] for i in order[:n]))
    return np.mean(found), len(found)
