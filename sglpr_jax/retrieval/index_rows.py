"""Checks of descriptors and places for every index: shapes, finite values, and the weights that made them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.data.choices import Scale
from sglpr_jax.files import in_short
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

MOST = 2**20
"""Maximum number of answers to a query, unless an index has more places."""
MOST_ANSWERS = 2**26
"""Maximum number of answers to all queries of a call: 1 GiB of rows and distances. A single query may have more."""


class Found(NamedTuple):
    """Nearest k places of each query, nearest first."""

    rows: Int[np.ndarray, "*q k"]
    """Row of each place; -1 if fewer than k places can be returned."""
    distances: Float[np.ndarray, "*q k"]
    """Descriptor distance of each place; infinite if fewer than k places can be returned."""


class NewPlaces(NamedTuple):
    """Checked places to be added."""

    ids: list[str]
    columns: dict[str, np.ndarray]
    """Descriptors (n, d) float32 and, if known, times (n,) and positions (n, 3) float64."""


def new_places(
    descriptors: Any,
    *,
    width: int,
    first: int,
    ids: Sequence[str] | str | None,
    times: Any,
    positions: Any,
    before: Sequence[str],
) -> NewPlaces:
    """Check places to be added from row `first` on.

    Arguments:
      descriptors: One descriptor (d,) or several (n, d).
      width: Length of a descriptor.
      first: Row of the first new place.
      ids: Names of the places. By default their rows.
      times: Times in seconds, or None.
      positions: Positions in metres, or None.
      before: Names of the columns of the places in the index. New places need the same columns.

    Raises:
      ValueError: If the descriptors have another width, a value is not finite, or the columns differ from `before`.
    """
    rows = checked_rows(descriptors, width)
    names = [f"{row:06d}" for row in range(first, first + len(rows))] if ids is None else ids
    names = [names] if isinstance(names, str) else [str(name) for name in names]
    if len(names) != len(rows):
        raise ValueError(f"expected {len(rows)} ids, one per descriptor, found {len(names)}")
    columns = {"descriptors": rows}
    if times is not None:
        columns["times"] = _finite("times", np.reshape(times, -1), (len(rows),))
    if positions is not None:
        columns["positions"] = _finite("positions", np.reshape(positions, (-1, 3)), (len(rows), 3))
    if first and set(columns) != set(before):
        raise ValueError(
            f"expected places with {', '.join(before)}, like the existing places, found {', '.join(columns)}"
        )
    if before and not len(rows):  # A new column would require all later places to have it.
        columns = {name: values for name, values in columns.items() if name in before}
    return NewPlaces(names, columns)


def places_of(file: DescriptorFile, *, distance: str, scale: Scale = 1) -> dict[str, Any]:
    """Return the places of a descriptor file as arguments of an index's `add`.

    Raises ValueError if `distance` does not compare its descriptors, or if its scans have another scale.
    """
    check_scale(scale, file.scale)
    if file.distance != distance:
        raise ValueError(f"expected descriptors compared by {distance}, found {file.distance}")
    about = {"times": file.times, "positions": file.positions, "weights_hash": file.weights_hash}
    return {"descriptors": file.descriptors, "ids": file.ids, **about}


def checked_rows(descriptors: Any, width: int) -> Float[np.ndarray, "n d"]:
    """Return one descriptor or several as float32 rows. Raises ValueError for a wrong width, NaN or infinity."""
    try:
        rows = np.atleast_2d(np.asarray(descriptors, np.float32))
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected descriptors of {width} numbers, found others ({in_short(error)})") from error
    return _finite("descriptors", rows, (len(rows), width)).astype(np.float32)


def given_flags(exclude: Any) -> Bool[np.ndarray, " n"] | None:
    """Convert the flags of excluded places to an array. Raises ValueError if they are not booleans."""
    if exclude is None:
        return None
    flags = np.asarray(exclude)
    if flags.dtype != bool and flags.size:
        raise ValueError(f"expected flags (True or False) of places to exclude, found {flags.dtype}")
    return flags.astype(bool)


def check_asked(k: int, exclude: Bool[np.ndarray, " n"] | None, *, queries: int, places: int) -> None:
    """Raise ValueError if k is below 1, k exceeds both `MOST` and `places`, the answers to several queries exceed
    `MOST_ANSWERS`, or `exclude` does not fit."""
    if k < 1:
        raise ValueError(f"expected k of 1 or more, found {k}")
    if k > max(MOST, places):
        raise ValueError(f"expected k up to {max(MOST, places)}, found {k}")
    if queries > 1 and queries * k > MOST_ANSWERS:
        raise ValueError(f"expected at most {MOST_ANSWERS // k} queries at a time for k = {k}, found {queries}")
    if exclude is not None and exclude.shape != (places,):
        raise ValueError(f"expected one flag for each of {places} places to exclude, found {exclude.shape}")


def check_weights(expected: str, found: str | None) -> None:
    """Raise ValueError if descriptors come from other weights. None skips the check."""
    if found is not None and found != expected:
        raise ValueError(
            f"expected descriptors of the weights {expected[:12] or '(none)'}, "
            f"found those of {found[:12] or '(none)'}: descriptors of different models are not comparable"
        )


def check_scale(expected: Scale, found: Scale) -> None:
    """Raise ValueError if descriptors come from scans of another scale."""
    if found != expected:
        raise ValueError(
            f"expected scale {expected}, found scale {found}: descriptors of scans with different scales are not "
            "comparable"
        )


def nearest_of(
    query: Float[np.ndarray, " d"], descriptors: Float[np.ndarray, "n d"], rows: Int[np.ndarray, " n"], k: int
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return the nearest k of a few candidates by their distances in float64, ties in the order of their rows."""
    apart = np.linalg.norm(query.astype(np.float64) - descriptors, axis=1)
    order = np.lexsort((rows, apart))[:k]
    return rows[order], apart[order]


def _finite(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    values = np.asarray(values, np.float64 if name != "descriptors" else np.float32)
    if values.shape != shape:
        raise ValueError(f"expected {name} of shape {shape}, found {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"expected finite {name}, found NaN or infinity")
    return values
