"""Names of the places of a map: `RECORDING/SCAN`, with a suffix after the recording if another place has this name."""

import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import naming, replacing
from sglpr_jax.loops.arguments import given_poses
from sglpr_jax.retrieval.index import Index
from sglpr_jax.schema import Column, check_columns
from sglpr_jax.se3 import ROTATION_TOLERANCE

Content = tuple[bytes | None, bytes]
"""Identity of a place: its descriptor (None if not known yet) and its pose, as bytes."""


def place_names(recording: Recording) -> list[str]:
    """Name of the place of each scan, whether or not the scan is in a map."""
    return [f"{recording.name}/{scan}" for scan in recording.ids]


def poses_by_id(recording: Recording, poses: Float[np.ndarray, "n 4 4"]) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Pose of each scan by the id of its place, whether or not the scan is in the map."""
    return dict(zip(place_names(recording), np.asarray(poses, np.float64), strict=True))


def free_names(names: Iterable[str], coming: Mapping[str, Content], *, taken: Mapping[str, Content]) -> list[str]:
    """Names for new places, with the first suffix of "", ~2, ~3, ... after the recording that makes them free.

    Arguments:
      names: Names of the new places. How many there are depends on how much of the drive is mapped.
      coming: All scans of the drive. The suffix must not depend on how much is mapped, so all of them are checked.
      taken: Places of the map.
    """
    names = list(names)
    recordings = {_recording_of(name) for name in names}
    drive = {name: content for name, content in coming.items() if _recording_of(name) in recordings}
    suffixes = itertools.chain([""], (f"~{number}" for number in itertools.count(2)))
    suffix = next(suffix for suffix in suffixes if _is_free(suffix, drive, taken))
    return [_with_suffix(name, suffix) for name in names]


def _is_free(suffix: str, drive: Mapping[str, Content], taken: Mapping[str, Content]) -> bool:
    """Whether no scan of the drive has, with the suffix, the name of another place."""
    for name, (descriptor, pose) in drive.items():
        there = taken.get(_with_suffix(name, suffix))
        if there is not None and (there[1] != pose or descriptor not in (None, there[0])):
            return False
    return True


def _recording_of(name: str) -> str:
    return name.rpartition("/")[0]


def _with_suffix(name: str, suffix: str) -> str:
    recording, slash, scan = name.rpartition("/")
    return f"{recording}{suffix}{slash}{scan}"


ARRAYS = {
    "images": Column("uint8", ("n", "h", "h")),
    "world_from_place": Column("float64", ("n", 4, 4)),
    "mountings": Column("float64", ("n", 4)),
    "mounting_deviations": Column("float64", ("n", 2), finite=False, optional=True),
}
"""Arrays of a map's file in addition to the index."""
REQUIRED = tuple(name for name, column in ARRAYS.items() if not column.optional)


def write_places(path: Path, index: Index, arrays: Mapping[str, np.ndarray]) -> None:
    """Write index and arrays atomically to one file."""
    content = index.to_bytes(dict(arrays))
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_places(path: Path | str, *, weights_hash: str | None) -> tuple[Index, dict[str, np.ndarray]]:
    """Read index and arrays. Raises the errors of `Index.load`, and ValueError if the file has no valid map."""
    index, more = Index.load_with(path, weights_hash=weights_hash)
    left_out = [name for name in REQUIRED if name not in more]
    if left_out:
        raise ValueError(f"{path}: expected a map of places, found an index without {', '.join(left_out)}")
    with naming(path):
        _check(index, more)
    return index, {name: more[name] for name in ARRAYS if name in more}


def _check(index: Index, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if the content of a file is not that of a map."""
    if index.distance != "l2":
        raise ValueError(f"expected descriptors compared by l2, found {index.distance}")
    check_columns(arrays, ARRAYS, n=len(index))
    if arrays["images"].shape[1] % 2:
        raise ValueError(f"expected images of an even number of cells, found {arrays['images'].shape[1:]}")
    given_poses(arrays["world_from_place"], of="world_from_place")
    for height, *up in np.unique(arrays["mountings"], axis=0).tolist():
        Mounting(height, tuple(up))
        if abs(np.linalg.norm(up) - 1) > ROTATION_TOLERANCE:
            raise ValueError(f"expected up directions of length 1 in mountings, found {up}")
