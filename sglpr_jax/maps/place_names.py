"""Names of the places of a map: `RECORDING/SCAN`, with a suffix after the recording if another place has this name."""

import itertools
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.recording import Recording

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

    `coming` has all scans of the drive, because the suffix must not depend on how much of it is mapped. `taken` has the
    places of the map.
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
