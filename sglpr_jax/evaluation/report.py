"""One descriptor file under every protocol, as a table and as JSON."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from sglpr_jax.evaluation.protocols import PROTOCOLS, Result
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def evaluate(file: DescriptorFile) -> list[Result]:
    """Return the result of every protocol on one file. Raises ValueError where the file has no positions."""
    return [protocol(file) for protocol in PROTOCOLS.values()]


def table(results: Sequence[Result], *, title: str = "") -> Table:
    """Return one row per protocol: what it is, its score, and what that rests on."""
    rows = Table("protocol", "rule", "score", "rests on", "distance", "poses", title=title)
    for result in results:
        counts = "\n".join(f"{count} {name}" for name, count in result.counts.items())
        rows.add_row(
            result.name, result.rule, format_score(result), counts, f"{result.dimensions}-D", result.pose_source
        )
    return rows


def comparison(methods: Mapping[str, Sequence[Result]], *, title: str = "") -> Table:
    """Return one row per method and one column per protocol. The methods are scored on the same sequence."""
    names = [result.name for result in next(iter(methods.values()))]
    rows = Table("method", *names, title=title)
    for method, results in methods.items():
        rows.add_row(method, *map(format_score, results))
    return rows


def format_score(result: Result) -> str:
    """Return the score to three places, or why there is none."""
    return "no revisit" if math.isnan(result.score) else f"{result.score:.3f}"


def to_json(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return plain values for `json.dump`: the score (null: no revisit), its rule, counts and where F1 is highest."""
    return [
        {
            "protocol": result.name,
            "rule": result.rule,
            "score": None if math.isnan(result.score) else result.score,
            "counts": result.counts,
            "dimensions": result.dimensions,
            "poses": result.pose_source,
            "at_f1max": _at_f1max(result),
        }
        for result in results
    ]


def _at_f1max(result: Result) -> dict[str, float] | None:
    """Return precision, recall and the largest descriptor distance accepted, where F1 is highest."""
    curve = result.curve
    if curve is None:
        return None
    return {
        "precision": float(curve.precision[curve.best]),
        "recall": float(curve.recall[curve.best]),
        "distance": float(-curve.thresholds[curve.best]),
    }
