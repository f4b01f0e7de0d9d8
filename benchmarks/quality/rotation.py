"""How far a descriptor moves when the scan is rotated by 1 to 359 degrees, beside how far away other places are.

python -m benchmarks.quality.rotation --data KITTI_BEV --seq 06
"""

from pathlib import Path

import jax
import numpy as np
import tyro
from jaxtyping import Float
from scipy.spatial.distance import cdist

import sglpr_jax
from sglpr_jax.data.views import view
from sglpr_jax.models.params import Params
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS

OTHER_PLACE_M = 20.0
BATCH = 64


def main(
    *,
    data: Path,
    seq: str | None = None,
    weights: tuple[str, ...] = (DEFAULT_WEIGHTS,),
    scans: int = 20,
    step_deg: int = 1,
    among: int = 1000,
) -> None:
    """Print how far descriptors move (median and 95 %), and as a share of the distance to the nearest other place.

    Args:
        data: a dataset with poses.
        seq: which recording of it.
        weights: names of shipped weights, or folders.
        scans: scans that are rotated, evenly spaced over the recording.
        step_deg: degrees between two rotations.
        among: scans, evenly spaced, among which the nearest other place is looked for, more than 20 m away.
    """
    recording = sglpr_jax.open_recording(data, seq)
    rotated, others = (np.unique(np.linspace(0, len(recording) - 1, n).astype(int)) for n in (scans, among))
    angles = np.radians(np.arange(step_deg, 360, step_deg))
    for name in weights:
        params = sglpr_jax.load(name)
        unrotated = descriptors(params, recording, [(row, None) for row in rotated])
        elsewhere = descriptors(params, recording, [(row, None) for row in others])
        nearest = nearest_other_place(recording.positions, rotated, others, cdist(unrotated, elsewhere))
        turned = descriptors(params, recording, [(row, angle) for row in rotated for angle in angles])
        moved = np.linalg.norm(turned.reshape(len(rotated), len(angles), -1) - unrotated[:, None], axis=2)
        report(name, moved, moved / nearest[:, None], nearest)


def descriptors(params: Params, recording: sglpr_jax.Recording, views: list) -> Float[np.ndarray, "n d"]:
    """Of rows of the recording, each rotated by its angle."""
    describe = jax.jit(sglpr_jax.describe)
    found = []
    for start in range(0, len(views), BATCH):
        part = views[start : start + BATCH]
        images = [image_of(params, recording, row, angle) for row, angle in part]
        images += images[-1:] * (BATCH - len(images))  # one program for all batches
        found.append(np.asarray(describe(params, np.stack(images)))[: len(part)])
    return np.concatenate(found)


def image_of(params: Params, recording: sglpr_jax.Recording, row: int, angle: float | None) -> Float[np.ndarray, "h w"]:
    config = params.config
    return np.asarray(view(recording.record(row), config.grid, image=config.image, angle=angle).image)


def nearest_other_place(
    positions: Float[np.ndarray, "n 3"], rows: np.ndarray, others: np.ndarray, distance: Float[np.ndarray, "r o"]
) -> Float[np.ndarray, " r"]:
    """For each row, the smallest distance of descriptors among the others that lie elsewhere."""
    apart = cdist(positions[rows, :2], positions[others, :2])
    return np.where(apart > OTHER_PLACE_M, distance, np.inf).min(axis=1)


def report(name: str, moved: np.ndarray, share: np.ndarray, nearest: np.ndarray) -> None:
    print(
        f"{name}: {moved.size} rotations of {len(moved)} scans: moved by {np.median(moved):.3f} (median), "
        f"{np.quantile(moved, 0.95):.3f} (95 %), {moved.max():.3f} (most); the nearest other place at "
        f"{np.median(nearest):.3f} (median), {nearest.min():.3f} (least); share {np.median(share):.3f} (median), "
        f"{np.quantile(share, 0.95):.3f} (95 %)"
    )


if __name__ == "__main__":
    tyro.cli(main)
