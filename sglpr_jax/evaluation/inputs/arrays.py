"""Descriptors and positions from arrays."""

import numpy as np
from jaxtyping import Float, Float32, Num

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def as_trajectory(
    positions: Float[np.ndarray, "n 3"] | None, times: Float[np.ndarray, " n"] | None = None
) -> Trajectory | None:
    """Return a trajectory of positions (metres, z up) and times (seconds), or None without positions."""
    if positions is None:
        return None
    return Trajectory(np.asarray(positions, np.float64), times, "positions given as an array", by_row=True)


def as_descriptors(
    rows: Num[np.ndarray, "n d"], trajectory: Trajectory, *, sequence: str, method: str, distance: str
) -> DescriptorFile:
    """Return descriptors from an array of real numbers. Row i belongs to pose i.

    Raises ValueError if a row is not finite.
    """
    return DescriptorFile(
        sequence=sequence,
        ids=tuple(f"{row:06d}" for row in range(len(rows))),
        positions=trajectory.positions,
        times=trajectory.times,
        descriptors=_as_float32(rows),
        pose_source=trajectory.source,
        config={"method": method},
        weights_hash="",
        distance=distance,
    )


def _as_float32(rows: Num[np.ndarray, "n d"]) -> Float32[np.ndarray, "n d"]:
    # Numbers too large for float32 become infinite. `DescriptorFile` rejects them, so numpy need not warn.
    with np.errstate(over="ignore"):
        return np.array(rows, dtype=np.float32)
