"""Which protocols score a source: those that are named, all that fit it, or the headlines."""

from collections.abc import Sequence

from sglpr_jax.evaluation.protocols import (
    PROTOCOLS,
    Kind,
    ScoredPairs,
    Source,
    kind_of,
    protocol_named,
    protocols_taking,
)

ALL = "all"
"""Stands for every protocol that fits."""
_IN_WORDS: dict[Kind, str] = {
    "top-k list": "a top-k list without scores",
    "scored top-k list": "a top-k list",
}


def check_names(names: Sequence[str]) -> None:
    """Raise ValueError, with the nearest name, unless all are protocols of one recording or `all`."""
    across_sessions = protocols_taking("sessions")
    for name in names:
        if name in across_sessions:
            raise ValueError(f"expected --database, a descriptor file to search, for protocol {name}; found none")
        if name != ALL:
            protocol_named(name, {other: PROTOCOLS[other] for other in PROTOCOLS if other not in across_sessions})


def chosen_protocols(source: Source | ScoredPairs, names: Sequence[str]) -> list[str]:
    """Return the protocols asked for: no name stands for the headlines that fit `source`, `all` for all that do.

    Where no headline fits, all that do are meant. Raises ValueError where `source` cannot be scored by one that is
    named.
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
