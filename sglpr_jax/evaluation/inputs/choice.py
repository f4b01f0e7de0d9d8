"""Which protocols an input can be scored by."""

from collections.abc import Callable, Mapping, Sequence

from sglpr_jax.evaluation.protocols import (
    CROSS_SESSION_PROTOCOLS,
    HEADLINES,
    PROTOCOLS,
    TOP_K_PROTOCOLS,
    Result,
    ScoredPairs,
    Source,
    TopK,
    protocol_named,
    scored_pairs_f1max,
)

LISTED_PAIRS: dict[str, Callable[..., Result]] = {"listed-pairs-f1max": scored_pairs_f1max}
ALL = "all"


def protocols_of(source: Source | ScoredPairs) -> Mapping[str, Callable[..., Result]]:
    """Return by name the protocols that can score `source`: a list without scores has nothing to put a threshold on."""
    if isinstance(source, ScoredPairs):
        return LISTED_PAIRS
    if not isinstance(source, TopK):
        return PROTOCOLS
    if source.scores is not None:
        return TOP_K_PROTOCOLS
    return {name: protocol for name, protocol in TOP_K_PROTOCOLS.items() if "recall" in name}


def check_names(names: Sequence[str]) -> None:
    """Raise ValueError, with the nearest name, unless all are protocols of one sequence or `all`."""
    for name in names:
        if name in CROSS_SESSION_PROTOCOLS:
            raise ValueError(f"expected --database, the map, for protocol {name}; found none")
        if name != ALL:
            protocol_named(name, PROTOCOLS | LISTED_PAIRS)


def chosen_protocols(source: Source | ScoredPairs, names: Sequence[str]) -> list[str]:
    """Return the protocols asked for: no name stands for the headlines that fit `source`, `all` for all that do.

    Raises ValueError where `source` cannot be scored by one that is named.
    """
    known = protocols_of(source)
    if not names:
        return [name for name in HEADLINES if name in known] or list(known)
    if ALL in names:
        return list(known)
    unfit = [name for name in names if name not in known]
    if unfit:
        raise ValueError(f"expected protocols for {_kind(source)}, which are {', '.join(known)}; found {unfit[0]}")
    return list(dict.fromkeys(names))


def _kind(source: Source | ScoredPairs) -> str:
    if isinstance(source, ScoredPairs):
        return "scored pairs"
    if isinstance(source, TopK):
        return "a top-k list without scores" if source.scores is None else "a top-k list"
    return "descriptors"
