"""Reader of ready-made BEV images in BEVPlace's layout.

- `00/imgs/000000.png`: 8-bit density image. The file name is the number of the frame. Frames may be missing.
- `00/labels/000000.png`: label image (`read_label_image`), optional for each frame.
- `00/pose.txt`: poses of the LiDAR, 12 numbers a line, one line per frame (optional).
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from sglpr_jax.data.formats.png import read_grey_png
from sglpr_jax.data.formats.pose_files import read_poses, rows_of
from sglpr_jax.data.readers.listing import files_in, scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording, image_record
from sglpr_jax.grid import DENSITY_MAX_COUNT, DENSITY_RESOLUTION_M


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root`, in order."""
    return tuple(sorted(folder.parent.name for folder in root.glob("*/imgs") if folder.is_dir()))


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open `root/<name>`. Without the file of poses, `positions` is `None`.

    Raises:
      FileNotFoundError: If the images are missing.
      ValueError: If the poses are malformed, or the name of an image is not the number of a row of poses.
    """
    folder = root / name
    image_paths = scans_in(folder / "imgs", ".png", kind="images")
    ids = tuple(path.stem for path in image_paths)
    poses = folder / "pose.txt"
    labels = {path.stem: path for path in files_in(folder / "labels", ".png")}
    return Recording(
        name=name,
        ids=ids,
        positions=_positions(poses, ids) if poses.is_file() else None,
        times=None,
        pose_source=f"{name}/pose.txt" if poses.is_file() else None,
        paths=image_paths,
        resolution_m=DENSITY_RESOLUTION_M,
        read=partial(image_record, read=read_image),
        label_paths=tuple(labels.get(image) for image in ids),
    )


def _positions(path: Path, ids: Sequence[str]) -> Float[np.ndarray, "n 3"]:
    """Positions of the frames in metres. Raises ValueError if an id is not the number of a row of poses."""
    world_from_lidar = read_poses(path)
    return world_from_lidar[rows_of(ids, rows=len(world_from_lidar), path=path), :, 3]


def read_image(path: Path) -> Float32[np.ndarray, "h w"]:
    """Return an image (h, w) in the orientation of eq. 1. Grey values 0..255 are scaled to counts 0..10.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is not a complete 8-bit greyscale image.
    """
    return as_counts(read_grey_png(path, bits=8))


def as_counts(grey: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Scale grey values 0..255 to counts 0..10."""
    return np.ascontiguousarray(grey) * np.float32(DENSITY_MAX_COUNT / 255)


READER = Reader("NN/imgs/*.png (BEV images)", recording_names, open_recording, rank=1)
