"""Descriptors and positions that are arrays already."""

import numpy as np
from jaxtyping import Float, Float32, Num

from sglpr_jax.data.formats.trajectory import Trajectory
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def as_trajectory(
    positions: Float[np.ndarray, "n 3"] | None, times: Float[np.ndarray, " n"] | None = None
) -> Trajectory | None:
    """Return positions (metres, z up) and times (seconds) as a pose file would give them; None without positions."""
    if positions is None:
        return None
    return Trajectory(np.asarray(positions, np.float64), times, "positions given as an array", by_row=True)


def as_descriptors(
    rows: Num[np.ndarray, "n d"], trajectory: Trajectory, *, sequence: str, method: str, distance: str
) -> DescriptorFile:
    """Return descriptors of any real type, row i that of pose i. Raises ValueError where a row is not finite."""
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
    # A number too large for float32 becomes infinite, which the descriptor file refuses; no need to warn as well.
    with np.errstate(over="ignore"):
        return np.array(rows, dtype=np.float32)
