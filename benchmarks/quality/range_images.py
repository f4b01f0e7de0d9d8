"""Labelled scans kept as range images: NN_FFFFFF.npz with `points` (n, 4) and learning classes `label` (n,)."""

from pathlib import Path

import numpy as np


def range_image_paths(folder: Path) -> list[Path]:
    """The files of a folder, in order; ends the program where there are none."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise SystemExit(f"{folder}: expected range images (*.npz), found none")
    return paths


def read_range_image(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) in metres and the class of each (n,)."""
    with np.load(path, allow_pickle=False) as file:
        return np.ascontiguousarray(file["points"][:, :3]), file["label"].astype(np.int32)
