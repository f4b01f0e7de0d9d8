"""The protocols: from one descriptor file to a number, each by its own published rule.

The same descriptors score very differently under different protocols, so every result carries its rule and the counts
it rests on. A new protocol is one more function and one more line in `PROTOCOLS`. Those that answer queries take a
descriptor file or a top-k list; `scored_pairs_f1max` takes scored pairs.
"""

import difflib
from collections.abc import Callable, Mapping
from functools import partial

from sglpr_jax.evaluation.protocols.bevplace import (
    bevplace_nclt_recall,
    bevplace_recall_at_1,
    bevplace_v1_recall,
)
from sglpr_jax.evaluation.protocols.contour_context import contour_context_f1max
from sglpr_jax.evaluation.protocols.logg3d import top1_f1max, top1_strict_f1max
from sglpr_jax.evaluation.protocols.overlap_transformer import overlap_transformer_f1max
from sglpr_jax.evaluation.protocols.pointnetvlad import pointnetvlad_recall
from sglpr_jax.evaluation.protocols.result import Decision, Result
from sglpr_jax.evaluation.protocols.scan_context import scan_context_f1max
from sglpr_jax.evaluation.protocols.scored_pairs import ScoredPairs, score_listed_pairs, scored_pairs_f1max
from sglpr_jax.evaluation.protocols.sgpr import sgpr_pairs_f1max
from sglpr_jax.evaluation.protocols.source import Source, TopK
from sglpr_jax.evaluation.protocols.ssc import pairs_f1max, ssc_recall

PROTOCOLS: dict[str, Callable[..., Result]] = {
    "top1-f1max": top1_f1max,
    "pairs-f1max": pairs_f1max,
    "bevplace-recall-at-1": bevplace_recall_at_1,
    "top1-strict-f1max": top1_strict_f1max,
    "scan-context-f1max": scan_context_f1max,
    "contour-context-f1max": contour_context_f1max,
    "overlap-transformer-f1max": overlap_transformer_f1max,
    "pairs-1-f1max": partial(pairs_f1max, negatives_per_positive=1),
    "pairs-10-f1max": partial(pairs_f1max, negatives_per_positive=10),
    "pairs-all-f1max": partial(pairs_f1max, negatives_per_positive=None),
    "sgpr-pairs-f1max": sgpr_pairs_f1max,
    "ssc-recall": ssc_recall,
    "bevplace-v1-recall": bevplace_v1_recall,
}
"""Every protocol of one descriptor file, by the name a command line takes."""

TOP_K_PROTOCOLS = {name: protocol for name, protocol in PROTOCOLS.items() if "pairs" not in name}
"""Those that score a top-k list too: all but the ones that compare pairs of frames."""

HEADLINES = ("top1-f1max", "pairs-f1max", "bevplace-recall-at-1")
"""The protocols to print where none are asked for."""

CROSS_SESSION_PROTOCOLS: dict[str, Callable[..., Result]] = {
    "bevplace-nclt-recall": bevplace_nclt_recall,
    "pointnetvlad-recall": pointnetvlad_recall,
}
"""Every protocol of two descriptor files, one session each, by the name a command line takes."""


def protocol_named(name: str, protocols: Mapping[str, Callable[..., Result]] = PROTOCOLS) -> Callable[..., Result]:
    """Return a protocol by its name; ValueError with the nearest name where there is none."""
    if name not in protocols:
        nearest = difflib.get_close_matches(name, protocols, n=1, cutoff=0)
        raise ValueError(f"no protocol {name!r}; did you mean {nearest[0]!r}? There are {', '.join(protocols)}")
    return protocols[name]


__all__ = [
    "CROSS_SESSION_PROTOCOLS",
    "HEADLINES",
    "PROTOCOLS",
    "TOP_K_PROTOCOLS",
    "Decision",
    "Result",
    "ScoredPairs",
    "Source",
    "TopK",
    "bevplace_nclt_recall",
    "bevplace_recall_at_1",
    "bevplace_v1_recall",
    "contour_context_f1max",
    "overlap_transformer_f1max",
    "pairs_f1max",
    "pointnetvlad_recall",
    "protocol_named",
    "scan_context_f1max",
    "score_listed_pairs",
    "scored_pairs_f1max",
    "sgpr_pairs_f1max",
    "ssc_recall",
    "top1_f1max",
    "top1_strict_f1max",
]
