"""Flags for the point cloud and the occupancy grid of a map, which several commands write."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from sglpr_jax.maps.config import CloudConfig, OccupancyConfig
from sglpr_jax.progress import progress_bar

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from jaxtyping import Float

    from sglpr_jax.data.recording import Recording
    from sglpr_jax.data.scan_stream import OnBadScan


@dataclasses.dataclass(frozen=True)
class CloudOptions:
    """Point cloud and occupancy grid of the scans at their poses, without moving objects."""

    cloud: Path | None = None
    """Also write the points of all scans in one frame (.ply, .pcd, .las, .laz)."""
    grid: Path | None = None
    """Also write an occupancy grid for planners, NAME.yaml and NAME.pgm, as the map server of ROS 2 reads it."""
    cloud_settings: CloudConfig = CloudConfig()
    grid_settings: OccupancyConfig = OccupancyConfig()

    @property
    def any(self) -> bool:
        """Whether a file is asked for."""
        return self.cloud is not None or self.grid is not None

    def check(self, recordings: "Sequence[Path]", *, submap_m: float) -> None:
        """Raise an error before long work if a file cannot be written, is an input, or if scans are submaps."""
        from sglpr_jax.data.formats.cloud_writers import check_cloud_path  # slow imports, not needed for --help
        from sglpr_jax.files import check_writable
        from sglpr_jax.maps.occupancy import check_grid_path

        if self.cloud is not None:
            check_cloud_path(self.cloud)
        if self.grid is not None:
            check_grid_path(self.grid)
        if self.any and submap_m:
            raise ValueError("--cloud and --grid need single scans: expected no --submap-m, found one")
        inputs = {path.resolve() for path in recordings}
        for path in filter(None, (self.cloud, self.grid)):
            check_writable(path)
            if not inputs.isdisjoint((path.resolve(), path.resolve().parent)):
                raise ValueError(f"{path}: expected a file that is no input and in no folder of scans, found one")

    def check_recordings(self, recordings: "Sequence[Recording]") -> None:
        """Raise ValueError if a file is asked for and a recording has ready-made images."""
        if self.any:
            from sglpr_jax.maps.point_cloud import require_points  # slow import, not needed for --help

            for recording in recordings:
                require_points(recording)

    def write(
        self,
        recordings: "Sequence[Recording]",
        poses: "Sequence[Float[np.ndarray, '_ 4 4']]",
        *,
        on_bad_scan: "OnBadScan | None" = None,
    ) -> None:
        """Write the files that the flags ask for, with progress on stderr."""
        if not self.any:
            return
        from sglpr_jax.data.formats.cloud_writers import write_cloud
        from sglpr_jax.maps.occupancy import occupancy_grid
        from sglpr_jax.maps.point_cloud import point_cloud

        scans = sum(map(len, recordings)) * (1 if self.cloud_settings.keep_moving else 2)
        with progress_bar("point cloud", scans) as show:
            points = point_cloud(
                recordings, poses, config=self.cloud_settings, on_bad_scan=on_bad_scan, on_progress=show
            )
        if self.cloud is not None:
            write_cloud(self.cloud, points)
            print(f"{self.cloud}: {len(points)} points")
        if self.grid is not None:
            grid = occupancy_grid(points, config=self.grid_settings)
            grid.save(self.grid)
            rows, columns = grid.cells.shape
            print(f"{self.grid}: {columns} x {rows} cells of {self.grid_settings.cell_m:g} m")
