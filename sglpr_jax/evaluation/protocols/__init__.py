"""Protocols: published rules that compute one score from the output of a method on a recording.

The same descriptors score very differently under different protocols, so every result states its distances and counts.
To add a protocol, add it to the file of its kind (`top1`, `pairs`, `recall`) and to `PROTOCOLS`.
"""

import difflib
from collections.abc import Mapping, Sequence

from sglpr_jax.evaluation.protocols import pairs, recall, top1
from sglpr_jax.evaluation.protocols.protocol import Input, Kind, Protocol, kind_of
from sglpr_jax.evaluation.protocols.result import Result

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
"""Name that selects every protocol that fits the input."""


def protocols_taking(kind: Kind) -> dict[str, Protocol]:
    """Return the protocols that score this kind of input, by name."""
    return {name: protocol for name, protocol in PROTOCOLS.items() if kind in protocol.takes}


def check_names(names: Sequence[str]) -> None:
    """Raise ValueError if a name is neither a protocol for one recording nor `all`. The message has a near name."""
    across_sessions = protocols_taking("sessions")
    available = [name for name in PROTOCOLS if name not in across_sessions]
    for name in names:
        if name in across_sessions:
            raise ValueError(f"expected --database with a descriptor file for protocol {name}, found none")
        if name not in (*available, ALL):
            (nearest,) = difflib.get_close_matches(name, available, n=1, cutoff=0)
            raise ValueError(
                f"expected a protocol, found {name!r}; did you mean {nearest!r}? Available: {', '.join(available)}"
            )


def chosen_protocols(kind: Kind, names: Sequence[str]) -> list[str]:
    """Return the given protocol names without repetition, or the names of protocols that fit this kind of input.

    Without names, the default protocols (`Protocol.headline`) that fit are returned. If none of them fits, or if a name
    is `all`, every protocol that fits is returned. Raises ValueError if a named protocol does not fit.
    """
    fitting = protocols_taking(kind)
    if not names:
        return [name for name, protocol in fitting.items() if protocol.headline] or list(fitting)
    if ALL in names:
        return list(fitting)
    for name in names:
        if name not in fitting:
            input_names = {"top-k list": "a top-k list without scores", "scored top-k list": "a top-k list"}
            input_name = input_names.get(kind, kind)
            raise ValueError(f"expected protocols for {input_name}, which are {', '.join(fitting)}; found {name}")
    return list(dict.fromkeys(names))


def score(source: Input, names: Sequence[str] = ()) -> list[Result]:
    """Return the results of the protocols of `chosen_protocols`. Raises ValueError if positions are missing."""
    return [PROTOCOLS[name](source) for name in chosen_protocols(kind_of(source), names)]
