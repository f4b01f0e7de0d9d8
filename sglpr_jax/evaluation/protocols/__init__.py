"""Protocols: published rules that compute one score from the output of a method on a recording.

The same descriptors score very differently under different protocols. Every result therefore has its rule and counts.
To add a protocol, add it to the file of its kind (`top1`, `pairs`, `recall`) and to `PROTOCOLS`.
"""

import difflib
from collections.abc import Mapping, Sequence

from sglpr_jax.evaluation.protocols import pairs, recall, top1
from sglpr_jax.evaluation.protocols.protocol import Protocol
from sglpr_jax.evaluation.protocols.source import Kind, ScoredPairs, Source, kind_of

PROTOCOLS: Mapping[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        top1.TOP1_F1MAX,
        pairs.PAIRS_F1MAX,
        recall.BEVPLACE_RECALL_AT_1,
        top1.SCAN_CONTEXT_F1MAX,
        top1.CONTOUR_CONTEXT_F1MAX,
        top1.OVERLAP_TRANSFORMER_F1MAX,
        pairs.PAIRS_1_F1MAX,
        pairs.PAIRS_10_F1MAX,
        pairs.PAIRS_ALL_F1MAX,
        pairs.SGPR_PAIRS_F1MAX,
        recall.SSC_RECALL,
        recall.BEVPLACE_V1_RECALL,
        pairs.LISTED_PAIRS_F1MAX,
        recall.BEVPLACE_NCLT_RECALL,
        recall.POINTNETVLAD_RECALL,
    )
}
"""All protocols by their names on the command line, in the order of tables."""
ALL = "all"
"""Name that selects every protocol that fits."""
_IN_WORDS: dict[Kind, str] = {
    "top-k list": "a top-k list without scores",
    "scored top-k list": "a top-k list",
}


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


def check_names(names: Sequence[str]) -> None:
    """Raise ValueError if a name is neither a protocol of one recording nor `all`. The message has the nearest name."""
    across_sessions = protocols_taking("sessions")
    for name in names:
        if name in across_sessions:
            raise ValueError(f"expected --database with a descriptor file for protocol {name}, found none")
        if name != ALL:
            protocol_named(name, {other: PROTOCOLS[other] for other in PROTOCOLS if other not in across_sessions})


def chosen_protocols(source: Source | ScoredPairs, names: Sequence[str]) -> list[str]:
    """Return the names of the protocols that score `source`.

    Without names, the default protocols (`Protocol.headline`) that fit are returned. If none of them fits, or for the
    name `all`, every protocol that fits is returned. Raises ValueError if a named protocol does not fit.
    """
    kind = kind_of(source)
    known = protocols_taking(kind)
    if not names:
        return [name for name, protocol in known.items() if protocol.headline] or list(known)
    if ALL in names:
        return list(known)
    unfit = [name for name in names if name not in known]
    if unfit:
        kind_in_words = _IN_WORDS.get(kind, kind)
        raise ValueError(f"expected protocols for {kind_in_words}, which are {', '.join(known)}; found {unfit[0]}")
    return list(dict.fromkeys(names))
