"""What was read of one scan, or of one ready-made image: its points or pixels, labels and lasers, from one read."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int32

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.label_images import read_label_image
from sglpr_jax.data.formats.scan_files import read_labels, read_points_and_lasers
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.labels import to_classes


@dataclass(frozen=True, eq=False)
class Record:
    """One scan (`points`) or one ready-made image (`image`); whatever it has not, or was not asked for, is None."""

    points: Float32[np.ndarray, "n 3"] | None = None
    """Metres in the LiDAR frame: x forward, y left, z up. Some may not be finite."""
    image: Float32[np.ndarray, "h w"] | None = None
    """In the orientation of eq. 1 (`image[v, u]`, x to the right, y up), on the scale of counts."""
    labels: Int32[np.ndarray, "..."] | None = None
    """Raw SemanticKITTI ids, one per point or pixel; 0 is a point or pixel whose class is not known."""
    labels_file: Path | None = None
    """Where they were read from, for messages."""
    lasers: Int32[np.ndarray, " n"] | None = None
    """The number of the laser that each point is from, where the file says so."""
    name: str = ""
    """For messages: "scan 000052 of sequence 08"."""
    position: Float[np.ndarray, " 3"] | None = None
    """Metres, z up."""
    time: float | None = None
    """Seconds."""
    mounting: Mounting | None = None
    """How the sensor was mounted; None: as models know it."""

    @property
    def upright_points(self) -> Float32[np.ndarray, "n 3"]:
        """The points as an upright sensor 1.73 m above the ground has them, which is what models see of a scan."""
        assert self.points is not None
        return self.points if self.mounting is None else self.mounting.level(self.points)

    @property
    def shape(self) -> tuple[int, ...]:
        """That of the labels: (n,) of a scan, (h, w) of an image."""
        seen = self.image if self.points is None else self.points[:, 0]
        return () if seen is None else seen.shape

    def classes(self, categories: int) -> Int32[np.ndarray, "..."] | None:
        """The class of every point or pixel among so many (docs/reference/labels.md), or None without labels.

        Raises ValueError, naming the file of the labels where it is known, for ids that do not exist.
        """
        if self.labels is None:
            return None
        try:
            return to_classes(self.labels, categories=categories)
        except ValueError as error:
            raise ValueError(f"{self.labels_file or self.name}: {error}") from error


ReadRecord = Callable[[Path, Path | None, bool], Record]
"""Reads a record: the file of the scan or image, that of its labels (None: without), and whether lasers are wanted."""


def scan_record(
    path: Path,
    labels: Path | None = None,
    lasers: bool = False,
    *,
    format: ScanFormat = "auto",
    records: RecordFormat = "kitti",
) -> Record:
    """Read a scan, each of its files once; "auto" takes a .bin whose name says nothing for `records`.

    Raises what `read_scan` and `read_labels` raise: ValueError, for instance, where there is not one label per point.
    """
    points, laser_of_point = read_points_and_lasers(path, format=format, records=records)
    raw = None if labels is None else read_labels(labels, points=len(points))
    return Record(points=points, labels=raw, labels_file=labels, lasers=laser_of_point if lasers else None)


def image_record(
    path: Path, labels: Path | None = None, lasers: bool = False, *, read: Callable[[Path], Float32[np.ndarray, "h w"]]
) -> Record:
    """Read a ready-made image with `read`, and its label image. Raises what these raise. No image has lasers."""
    image = read(path)
    return Record(image=image, labels=None if labels is None else read_label_image(labels, shape=image.shape))
