"""Descriptor files and other archives of arrays."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.data.sampling.descriptor_cache import DescriptorCache
from sglpr_jax.evaluation.inputs import read_input
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

from .damage import (
    BYTES,
    Damage,
    Damaged,
    change_json,
)
from .road import DESCRIPTORS, POSITIONS, TIMES, N, Road, as_whole, plain


def npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def arrays_of(content: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(content)) as archive:
        return dict(archive)


def _broken_array(array: np.ndarray, draw: Random) -> np.ndarray:
    if array.dtype.kind != "f":
        return draw.choice((array[..., None], np.zeros(array.shape), np.array(["0"] * N), array.astype("S")))
    value = draw.choice((np.nan, np.inf, -np.inf))
    holed = array.copy()
    holed.flat[draw.randrange(array.size)] = value
    others = (array[:-1], array[None], array[:, None], array[..., :0], array.astype(np.float16), array.astype(np.int64))
    return draw.choice((holed, *others, array.astype(str), array.T[::-1].T[:0]))


def break_array(content: bytes, draw: Random) -> Damaged:
    """One array has another shape or type, or a value that is not finite."""
    arrays = arrays_of(content)
    name = draw.choice(list(arrays))
    return Damaged(npz({**arrays, name: _broken_array(arrays[name], draw)}))


def drop_array(content: bytes, draw: Random) -> Damaged:
    """One array that must be there is missing."""
    arrays = arrays_of(content)
    del arrays[draw.choice([name for name in arrays if name not in ("positions", "times")])]
    return Damaged(npz(arrays))


def change_about(content: bytes, draw: Random) -> Damaged:
    """The JSON of a descriptor file has another value somewhere: read as it stands there, or refused."""
    arrays = arrays_of(content)
    about = change_json(json.loads(str(arrays["about"])), draw)
    return Damaged(npz({**arrays, "about": np.array(json.dumps(about))}), "either")


def double_id(content: bytes, draw: Random) -> Damaged:
    """Two scans of one name."""
    arrays = arrays_of(content)
    ids = arrays["ids"].copy()
    a, b = draw.sample(range(N), 2)
    ids[a] = ids[b]
    return Damaged(npz({**arrays, "ids": ids}))


IDS = tuple(f"{i:06d}" for i in range(N))
ABOUT = {"format": "sglpr-jax descriptors 2", "sequence": "08", "pose_source": "poses.txt", "config": {"method": "m"}}
ABOUT |= {"weights_hash": "ab", "distance": "l2"}
ARRAYS = {"ids": np.array(IDS), "descriptors": DESCRIPTORS, "positions": POSITIONS, "times": TIMES}
DESCRIPTOR_FILE = npz({"about": np.array(json.dumps(ABOUT)), **ARRAYS})


def _same_descriptors(found: DescriptorFile, content: bytes) -> bool:
    """The arrays are the whole file's; what it says of them is what stands there, every value of its type."""
    about = json.loads(str(arrays_of(content)["about"]))
    said = {name: getattr(found, name) for name in ABOUT if name != "format"}
    fits = all(isinstance(about[name], str) for name in ("sequence", "weights_hash", "distance"))
    return fits and said == {name: about[name] for name in said} and plain(_arrays(found)) == plain(ARRAYS)


def _arrays(found: DescriptorFile) -> dict[str, Any]:
    arrays = {name: getattr(found, name) for name in ARRAYS}
    return {**arrays, "ids": np.array(found.ids)}


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _read_matrix(path: Path) -> Any:
    return read_input(path, Trajectory(POSITIONS, TIMES, "poses"), sequence="08")


def _same_matrix(found: DescriptorFile, content: bytes) -> bool:
    with np.errstate(all="ignore"):
        rows = np.load(io.BytesIO(content)).astype(np.float32)
    return np.array_equal(found.descriptors, rows) and len(found) == N


NPZ: dict[str, Damage] = {**BYTES, "array": break_array, "drop": drop_array}
CACHE = {"places": np.arange(N), "descriptors": DESCRIPTORS}
ROADS = (
    Road(
        "descriptor file",
        "08.npz",
        DESCRIPTOR_FILE,
        DescriptorFile.load,
        _same_descriptors,
        {**NPZ, "about": change_about, "double id": double_id},
    ),
    Road(
        "descriptor cache",
        "3.npz",
        npz(CACHE),
        damages={**BYTES, "drop": drop_array},
        **as_whole(DescriptorCache.load, DescriptorCache(**CACHE)),
    ),
    Road("matrix", "mine.npy", npy(DESCRIPTORS), _read_matrix, _same_matrix, BYTES),
)
