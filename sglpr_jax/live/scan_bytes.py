"""A scan of a live map as bytes: what the search needs of it, its comparisons, and its times."""

import json
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors.numpy
from jaxtyping import Float

from sglpr_jax.data.formats.tensors import tensors_as_bytes
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.files import in_short
from sglpr_jax.loops.candidates import Compared
from sglpr_jax.loops.checkpoint import COLUMNS, columns, compared_of
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.schema import Column, check_about, check_columns

FORMAT = "sglpr-jax live scan 3"
ABOUT = {"name": str, "stamp": float, "time": float, "wall": float, "continues": bool, "mounting": dict | None}
"""JSON values of each scan."""
ARRAYS = {
    "descriptor": Column("float32", ("d",)),
    "image": Column("uint8", ("h", "h")),
    "pose": Column("float64", (4, 4), optional=True),
    **{name: COLUMNS[name] for name in ("counts", "fitted", "fits", "links")},
}
"""Arrays of each scan."""


class LiveScan(NamedTuple):
    """A described scan of a live map."""

    seen: Seen
    compared: Compared
    pose: Float[np.ndarray, "4 4"] | None
    """Pose of the LiDAR by odometry."""
    continues: bool
    """Whether the motion since the last scan is known."""
    name: str
    """`Record.name` of the scan."""
    stamp: float
    """Time of the header, in seconds."""
    time: float
    """Time of `Clock`, in seconds."""
    wall: float
    """Time of the computer when the scan was added, in seconds since 1970."""


def to_bytes(scan: LiveScan) -> bytes:
    """Return the compressed bytes of a scan."""
    arrays = {"descriptor": scan.seen.descriptor, "image": scan.seen.image, **columns([scan.compared])}
    if scan.pose is not None:
        arrays["pose"] = np.asarray(scan.pose, np.float64)
    about = {
        "format": FORMAT,
        **{name: getattr(scan, name) for name in ABOUT if name != "mounting"},
        "mounting": None if scan.seen.mounting is None else scan.seen.mounting.fields,
    }
    contiguous = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    return zlib.compress(tensors_as_bytes(contiguous, {"scan": json.dumps(about)}), 1)


def from_bytes(content: bytes, frame: int, *, source: Path) -> LiveScan:
    """Return the scan of `to_bytes`, which has this frame number.

    Raises ValueError, which names `source`, if the content is invalid.
    """
    try:
        plain = zlib.decompress(content)
        arrays = safetensors.numpy.load(plain)
        about = _about(plain)
        check_about(about, ABOUT, format=FORMAT)
        check_columns(arrays, ARRAYS, n=1)
        fitted = arrays["fitted"]
        if arrays["counts"][0] != len(fitted) or ((fitted < 0) | (fitted >= frame)).any():
            raise ValueError(f"expected comparisons of frame {frame}, found others")
        mounting = None if about["mounting"] is None else _mounting(about["mounting"])
    except Exception as error:  # another program may have written it
        raise ValueError(f"{source}: expected scan {frame} of a live map, found others ({in_short(error)})") from error
    (compared,) = compared_of(arrays)
    seen = Seen(arrays["descriptor"], arrays["image"], mounting)
    known = {name: about[name] for name in ("continues", "name", "stamp", "time", "wall")}
    return LiveScan(seen, compared, arrays.get("pose"), **known)


def _about(content: bytes) -> dict:
    size = int.from_bytes(content[:8], "little")
    return json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["scan"])


def _mounting(fields: dict) -> Mounting:
    return Mounting(**{**fields, "up": tuple(fields["up"])})
