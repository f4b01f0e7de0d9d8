"""What every reader returns: a sequence of scans, or a sequence of ready-made BEV images.

Both have the same first five fields. A file is read only when it is asked for.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int32

from sglpr_jax.data.label_maps import read_label_map
from sglpr_jax.data.scan_files import read_labels


@dataclass(frozen=True, eq=False)
class ScanSequence:
    """Scans in the order they were taken, with their positions, and labels where there are any.

    `ids` are the file stems ("000052"). `positions` are metres, z up, or None where nothing tells them; `pose_source`
    names where they come from. `times` are seconds, or None. `label_paths` has None for each scan without labels.
    `read_lasers` is there where the files say which laser each point is from.
    """

    name: str
    ids: tuple[str, ...]
    positions: Float[np.ndarray, "n 3"] | None
    times: Float[np.ndarray, " n"] | None
    pose_source: str | None
    scan_paths: tuple[Path, ...]
    label_paths: tuple[Path | None, ...]
    read_scan: Callable[[Path], np.ndarray]
    read_lasers: Callable[[Path], np.ndarray | None] | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def has_labels(self) -> bool:
        """Whether any scan has labels."""
        return any(path is not None for path in self.label_paths)

    def points(self, i: int) -> Float32[np.ndarray, "n 3"]:
        """Read scan `i`: points in metres, x forward, y left, z up. A scan may hold points that are not finite."""
        return self.read_scan(self.scan_paths[i])

    def labels(self, i: int) -> Int32[np.ndarray, " n"] | None:
        """Read the raw SemanticKITTI ids of scan `i`, one per point, or None where it has no labels.

        Raises ValueError where the file has not one label per point.
        """
        path = self.label_paths[i]
        return None if path is None else read_labels(path, points=len(self.points(i)))

    def lasers(self, i: int) -> Int32[np.ndarray, " n"] | None:
        """Read the number of the laser that each point of scan `i` is from, or None where the file does not say."""
        return None if self.read_lasers is None else self.read_lasers(self.scan_paths[i])


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """Ready-made BEV images in the order their scans were taken, with their positions, and labels where there are any.

    `resolution_m` is the edge of a pixel in metres. The other fields are those of `ScanSequence`; without `label_paths`
    no image has labels.
    """

    name: str
    ids: tuple[str, ...]
    positions: Float[np.ndarray, "n 3"] | None
    times: Float[np.ndarray, " n"] | None
    pose_source: str | None
    image_paths: tuple[Path, ...]
    resolution_m: float
    read_image: Callable[[Path], np.ndarray]
    label_paths: tuple[Path | None, ...] = field(default=(), kw_only=True)

    def __post_init__(self):
        if not self.label_paths:
            object.__setattr__(self, "label_paths", (None,) * len(self.ids))

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def has_labels(self) -> bool:
        """Whether any image has labels."""
        return any(path is not None for path in self.label_paths)

    def image(self, i: int) -> Float32[np.ndarray, "h w"]:
        """Read image `i` in the orientation of eq. 1 (`image[v, u]`, x to the right, y up), on the scale of counts."""
        return self.read_image(self.image_paths[i])

    def labels(self, i: int) -> Int32[np.ndarray, "h w"] | None:
        """Read the raw SemanticKITTI ids of image `i`, one per pixel, or None where it has no labels.

        0 is an empty pixel or one whose class is not known. Raises what `read_label_map` raises.
        """
        path = self.label_paths[i]
        return None if path is None else read_label_map(path, shape=self.image(i).shape)


Drive = ScanSequence | ImageSequence
"""What a reader returns; the drives of one dataset are all of one kind."""
