"""Choice of the protocols for a source: named protocols, all that fit, or the default ones."""

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
"""Name that selects every protocol that fits."""
_IN_WORDS: dict[Kind, str] = {
    "top-k list": "a top-k list without scores",
    "scored top-k list": "a top-k list",
}


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
