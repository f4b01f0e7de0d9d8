"""Pairs of recordings that may show the same places, for a search of loops between them."""

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sglpr_jax.retrieval.fleet_index import FleetIndex

if TYPE_CHECKING:
    import pyarrow

BLOCK = 256
"""Number of scans that are searched at a time."""


class Overlap(NamedTuple):
    """Two recordings that may show the same places, in the order of their names."""

    recording: str
    other: str
    scans: int
    """Number of scans of one recording that have a near place in the other one."""


def overlaps(
    index: FleetIndex,
    rows: "pyarrow.Table",
    *,
    where: str = "",
    max_distance: float = 0.8,
    min_scans: int = 5,
    k: int = 10,
) -> list[Overlap]:
    """Find the recordings of an index that may overlap with one recording, most scans first.

    Arguments:
      index: Index of the fleet.
      rows: Places of one recording, from `read_places`.
      where: Condition in SQL on the other recordings, such as "site = 'berlin'".
      max_distance: Maximum distance between the descriptors of a scan and of a place near to it.
      min_scans: Minimum number of scans that have a near place in the other recording.
      k: Number of places that are found for each scan.
    """
    own = rows["recording"][0].as_py()
    condition = " AND ".join(
        [f"recording != '{own.replace(chr(39), 2 * chr(39))}'", *([f"({where})"] if where else [])]
    )
    pairs = set[tuple[int, str]]()
    descriptors = np.stack(rows["descriptor"].to_numpy())
    for start in range(0, len(descriptors), BLOCK):
        found = index.query(descriptors[start : start + BLOCK], k, where=condition, columns=["recording"])
        near = found["distance"].to_numpy() <= max_distance
        queries, others = found["query"].to_numpy()[near] + start, found["recording"].to_numpy()[near]
        pairs |= set(zip(queries.tolist(), others.tolist(), strict=True))
    counted = Counter(other for _, other in pairs)
    return [Overlap(min(own, other), max(own, other), n) for other, n in counted.most_common() if n >= min_scans]
