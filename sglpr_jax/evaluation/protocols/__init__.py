"""The protocols: what a method says of a recording becomes a number, each by its own published rule.

The same descriptors score very differently under different protocols, so every result carries its rule and the counts
it rests on. A new protocol is one file here and its name in the list.
"""

import difflib
from collections.abc import Mapping

from sglpr_jax.evaluation.protocols.bevplace_nclt_recall import BEVPLACE_NCLT_RECALL
from sglpr_jax.evaluation.protocols.bevplace_recall_at_1 import BEVPLACE_RECALL_AT_1
from sglpr_jax.evaluation.protocols.bevplace_v1_recall import BEVPLACE_V1_RECALL
from sglpr_jax.evaluation.protocols.contour_context_f1max import CONTOUR_CONTEXT_F1MAX
from sglpr_jax.evaluation.protocols.listed_pairs_f1max import LISTED_PAIRS_F1MAX
from sglpr_jax.evaluation.protocols.overlap_transformer_f1max import OVERLAP_TRANSFORMER_F1MAX
from sglpr_jax.evaluation.protocols.pairs_f1max import PAIRS_1_F1MAX, PAIRS_10_F1MAX, PAIRS_ALL_F1MAX, PAIRS_F1MAX
from sglpr_jax.evaluation.protocols.pointnetvlad_recall import POINTNETVLAD_RECALL
from sglpr_jax.evaluation.protocols.protocol import Kind, Protocol, kind_of
from sglpr_jax.evaluation.protocols.result import Decision, Result
from sglpr_jax.evaluation.protocols.scan_context_f1max import SCAN_CONTEXT_F1MAX
from sglpr_jax.evaluation.protocols.sgpr_pairs_f1max import SGPR_PAIRS_F1MAX
from sglpr_jax.evaluation.protocols.source import ScoredPairs, Source, TopK
from sglpr_jax.evaluation.protocols.ssc_recall import SSC_RECALL
from sglpr_jax.evaluation.protocols.top1_f1max import TOP1_F1MAX
from sglpr_jax.evaluation.protocols.top1_strict_f1max import TOP1_STRICT_F1MAX

PROTOCOLS: Mapping[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        TOP1_F1MAX,
        PAIRS_F1MAX,
        BEVPLACE_RECALL_AT_1,
        TOP1_STRICT_F1MAX,
        SCAN_CONTEXT_F1MAX,
        CONTOUR_CONTEXT_F1MAX,
        OVERLAP_TRANSFORMER_F1MAX,
        PAIRS_1_F1MAX,
        PAIRS_10_F1MAX,
        PAIRS_ALL_F1MAX,
        SGPR_PAIRS_F1MAX,
        SSC_RECALL,
        BEVPLACE_V1_RECALL,
        LISTED_PAIRS_F1MAX,
        BEVPLACE_NCLT_RECALL,
        POINTNETVLAD_RECALL,
    )
}
"""Every protocol, by the name that a command line takes, in the order of tables."""


def protocols_taking(kind: Kind) -> dict[str, Protocol]:
    """Return by name the protocols that score what is of this kind."""
    return {name: protocol for name, protocol in PROTOCOLS.items() if kind in protocol.takes}


def protocol_named(name: str, among: Mapping[str, Protocol] = PROTOCOLS) -> Protocol:
    """Return a protocol by its name; ValueError with the nearest name where there is none."""
    if name not in among:
        nearest = difflib.get_close_matches(name, among, n=1, cutoff=0)
        raise ValueError(f"no protocol {name!r}; did you mean {nearest[0]!r}? There are {', '.join(among)}")
    return among[name]


__all__ = [
    "PROTOCOLS",
    "Decision",
    "Kind",
    "Protocol",
    "Result",
    "ScoredPairs",
    "Source",
    "TopK",
    "kind_of",
    "protocol_named",
    "protocols_taking",
]
