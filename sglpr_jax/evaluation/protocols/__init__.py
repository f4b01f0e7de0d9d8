"""Protocols: published rules that compute one score from the output of a method on a recording.

The same descriptors score very differently under different protocols. Every result therefore has its rule and counts.
To add a protocol, add a file to this package and its name to `PROTOCOLS`.
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
"""All protocols by their names on the command line, in the order of tables."""


def protocols_taking(kind: Kind) -> dict[str, Protocol]:
    """Return the protocols that score this kind of input, by name."""
    return {name: protocol for name, protocol in PROTOCOLS.items() if kind in protocol.takes}


def protocol_named(name: str, among: Mapping[str, Protocol] = PROTOCOLS) -> Protocol:
    """Return a protocol by name. Raises ValueError with the nearest name if the protocol does not exist."""
    if name not in among:
        nearest = difflib.get_close_matches(name, among, n=1, cutoff=0)
        raise ValueError(
            f"expected a protocol, found {name!r}; did you mean {nearest[0]!r}? Available: {', '.join(among)}"
        )
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
