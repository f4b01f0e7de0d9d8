"""Sequences of ready-made BEV images in BEVPlace's layout.

00/imgs/000000.png     8-bit density images; the number is the frame, and frames may be left out
00/labels/000000.png   what their pixels show (`label_images.py`; optional, each)
00/pose.txt            12 numbers a line, LiDAR frame, one line per frame
"""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from sglpr_jax.data.density_grid import MAX_COUNT, RESOLUTION_M
from sglpr_jax.data.formats.grey_png import read_grey_png
from sglpr_jax.data.formats.pose_files import read_poses, rows_of
from sglpr_jax.data.listing import files_in
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import image_record
from sglpr_jax.data.recording import Recording


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root`, in order."""
    return tuple(sorted(folder.parent.name for folder in root.glob("*/imgs") if folder.is_dir()))


def open_recording(root: Path, name: str) -> Recording:
    """Open `root/<name>`. Raises FileNotFoundError without images or poses, ValueError on malformed poses."""
    folder = root / name
    image_paths = files_in(folder / "imgs", ".png")
    if not image_paths:
        raise FileNotFoundError(f"{folder / 'imgs'}: expected images (*.png), found none")
    ids = tuple(path.stem for path in image_paths)
    world_from_lidar = read_poses(folder / "pose.txt")
    labels = {path.stem: path for path in files_in(folder / "labels", ".png")}
    rows = rows_of(ids, rows=len(world_from_lidar), path=folder / "pose.txt")
    return Recording(
        name=name,
        ids=ids,
        positions=world_from_lidar[rows, :, 3],
        times=None,
        pose_source=f"{name}/pose.txt",
        paths=image_paths,
        resolution_m=RESOLUTION_M,
        read=partial(image_record, read=read_image),
        label_paths=tuple(labels.get(image) for image in ids),
    )


def read_image(path: Path) -> Float32[np.ndarray, "h w"]:
    """Return an image (h, w) in eq. 1's orientation, its grey values 0..255 scaled to counts 0..10.

    Raises FileNotFoundError, and ValueError where the file is no whole 8-bit grey image.
    """
    return as_counts(read_grey_png(path, bits=8))


def as_counts(grey: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """The counts 0..10 that grey values 0..255 stand for."""
    return np.ascontiguousarray(grey) * np.float32(MAX_COUNT / 255)


READER = Reader(
    layout="NN/imgs/*.png with NN/pose.txt (BEV images)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(root, name),
    rank=1,
)
