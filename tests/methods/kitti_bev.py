"""The real BEV images of KITTI, with their positions."""

from pathlib import Path

import numpy as np

from sglpr_jax.data.readers import open_recording
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

KITTI_BEV_RADIUS = 62.0
"""Pixels: the images are 151 x 151, with content in the middle 125 x 125."""


def read_kitti_bev(shared: Path, name: str) -> tuple[np.ndarray, DescriptorFile]:
    """Return the images of a sequence, and its descriptor file still without real descriptors."""
    sequence = open_recording(shared / "data" / "kitti_bev", name)
    images = np.stack([sequence.image(i) for i in range(len(sequence))])
    file = DescriptorFile(
        name, sequence.ids, sequence.positions, sequence.times, images[:, 0], sequence.pose_source, {}, ""
    )
    return images, file
