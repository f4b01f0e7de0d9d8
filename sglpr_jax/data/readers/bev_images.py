"""Reader of ready-made BEV images in BEVPlace's layout.

- `00/imgs/000000.png`: 8-bit density image. The file name is the number of the frame. Frames may be missing.
- `00/labels/000000.png`: label image (`read_label_image`), optional for each frame.
- `00/pose.txt`: poses of the LiDAR, 12 numbers a line, one line per frame (optional).
"""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.density_image import as_counts
from sglpr_jax.data.formats.png import image_scan, read_grey_png
from sglpr_jax.data.formats.pose_files import read_kitti, rows_of_frames
from sglpr_jax.data.readers.listing import files_in, names_of, scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.grid import DENSITY_RESOLUTION_M


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the sequence `root/<name>`. Raises FileNotFoundError without images."""
    folder = root / name
    paths = scans_in(folder / "imgs", ".png", kind="images")
    ids = tuple(path.stem for path in paths)
    labels = {path.stem: path for path in files_in(folder / "labels", ".png")}
    pose_file = folder / "pose.txt"
    positions = None
    if pose_file.is_file():
        positions = rows_of_frames(read_kitti(pose_file, camera=False), ids, path=pose_file)[:, :3, 3]
    return Recording(
        name=name,
        ids=ids,
        paths=paths,
        read=partial(image_scan, read=read_image),
        positions=positions,
        pose_source=None if positions is None else f"{name}/pose.txt",
        label_paths=tuple(labels.get(image_id) for image_id in ids),
        resolution_m=DENSITY_RESOLUTION_M,
    )


def read_image(path: Path) -> Float32[np.ndarray, "h w"]:
    """Return an 8-bit density image as counts 0..10 in the orientation of eq. 1: x to the right, y up."""
    return as_counts(read_grey_png(path, bits=8))


READER = Reader("NN/imgs/*.png (BEV images)", partial(names_of, pattern="*/imgs/"), open_recording, rank=1)
