"""Occupancy grid of a point cloud, for planners that drive on the ground. Files of ROS's map server."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy.ndimage import binary_closing, binary_dilation

from sglpr_jax.data.cloud_map import height_above_ground
from sglpr_jax.data.formats.cloud_writers import as_cloud
from sglpr_jax.files import text_bytes, write_all
from sglpr_jax.maps.config import OccupancyConfig

FREE, UNKNOWN, OCCUPIED = 254, 205, 0
"""Grey values of cells, as the map server writes them."""
OCCUPIED_SHARE, FREE_SHARE = 0.65, 0.196
"""Thresholds of (255 - grey) / 255. An unknown cell is between them."""
MOST_CELLS = 1 << 28
"""Maximum number of cells of a grid."""
MAX_STEP_M = 5.0
"""Maximum distance between two poses, in metres, between which the robot is assumed to have driven straight."""


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Grid of free, occupied and unknown cells, seen from above."""

    cells: UInt8[np.ndarray, "rows columns"]
    """`FREE`, `OCCUPIED` or `UNKNOWN`. Row 0 has the largest y, column 0 the smallest x."""
    corner: tuple[float, float]
    """Smallest x and y of the grid, in metres."""
    config: OccupancyConfig

    def save(self, path: Path | str) -> list[Path]:
        """Write the grid as an image, NAME.pgm, and its description NAME.yaml, as the map server reads them.

        Raises ValueError if `path` does not end in .yaml.
        """
        path = Path(path)
        check_grid_path(path)
        (x, y), image_name = self.corner, f"{path.stem}.pgm"
        description = (
            f"image: {json.dumps(image_name, ensure_ascii=False)}\nmode: trinary\nresolution: {self.config.cell_m:g}\n"
            f"origin: [{x:.3f}, {y:.3f}, 0]\nnegate: 0\noccupied_thresh: {OCCUPIED_SHARE}\nfree_thresh: {FREE_SHARE}\n"
        )
        image = Image.fromarray(self.cells)
        files = {
            image_name: partial(image.save, format="ppm"),
            path.name: partial(Path.write_bytes, data=text_bytes(description)),
        }
        return write_all(path.parent, files)


def check_grid_path(path: Path) -> None:
    """Raise ValueError if `path` does not end in .yaml."""
    if path.suffix != ".yaml":
        raise ValueError(f"{path}: expected a name that ends in .yaml, found {path.suffix or 'no suffix'}")


def occupancy_grid(
    points: Float[np.ndarray, "n 3"],
    *,
    driven: Sequence[Float[np.ndarray, "_ 4 4"]] = (),
    config: OccupancyConfig = OccupancyConfig(),
) -> OccupancyGrid:
    """Return the occupancy grid of a point cloud in metres, z up, without moving objects.

    The lowest point around a point is the ground (`height_above_ground`). Cells with a point between a step and the
    height of the robot are occupied, other cells with ground are free, and so are gaps of a cell between free cells.
    The points show one storey only.

    Arguments:
      points: The cloud.
      driven: Trajectories of the sensor in the frame of the cloud. Where the robot drove, cells are free.
      config: Cells and size of the robot.

    Raises ValueError without points or for other arrays, or if the grid has too many cells.
    """
    points = as_cloud(points)
    corner = np.floor(points[:, :2].min(axis=0) / config.cell_m) * config.cell_m
    columns, rows = np.floor((points[:, :2].max(axis=0) - corner) / config.cell_m).astype(int) + 1
    if int(rows) * int(columns) > MOST_CELLS:
        raise ValueError(f"expected a grid of at most {MOST_CELLS} cells, found {rows} x {columns}; use larger cells")
    relative = (points - [*corner, 0.0]).astype(np.float32)
    column, row = np.floor(relative[:, :2].T / config.cell_m).astype(np.int64)
    cell = row.clip(0, rows - 1) * columns + column.clip(0, columns - 1)
    height = height_above_ground(relative)
    occupied, free = np.zeros((2, rows * columns), bool)
    occupied[cell[(height > config.step_m) & (height < config.robot_height_m)]] = True
    free[cell[height <= config.step_m]] = True
    free = free.reshape(rows, columns)
    free |= binary_closing(free, np.ones((3, 3)))
    cells = np.full((rows, columns), UNKNOWN, np.uint8)
    cells[free] = FREE
    cells[occupied.reshape(rows, columns)] = OCCUPIED
    cells[_driven_cells([poses[:, :2, 3] - corner for poses in driven], cells.shape, config)] = FREE
    return OccupancyGrid(cells[::-1], (float(corner[0]), float(corner[1])), config)


def _driven_cells(
    paths: Sequence[Float[np.ndarray, "_ 2"]], shape: tuple[int, int], config: OccupancyConfig
) -> Bool[np.ndarray, "rows columns"]:
    """Return the cells that a round robot passed on its paths, in metres from the corner of the grid."""
    passed = np.zeros(shape, bool)
    for path in paths:
        steps = np.diff(path, axis=0)
        lengths_m = np.linalg.norm(steps, axis=1)
        for start, step, length_m in zip(path[:-1], steps, lengths_m, strict=True):
            if length_m <= MAX_STEP_M:
                along = np.linspace(0, 1, int(2 * length_m / config.cell_m) + 2)[:, None]
                column, row = np.floor((start + along * step) / config.cell_m).astype(int).T
                inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
                passed[row[inside], column[inside]] = True
    reach = round(config.robot_radius_m / config.cell_m)
    across, along = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return binary_dilation(passed, across**2 + along**2 <= reach**2)
