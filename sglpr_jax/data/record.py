"""Data of one scan or one ready-made image: points or pixels, labels, lasers and times of points."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.bin_records import Records
from sglpr_jax.data.formats.label_images import read_label_image
from sglpr_jax.data.formats.scan_files import read_labels, read_scan_records
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.point_times import TimeField
from sglpr_jax.files import naming
from sglpr_jax.labels import to_classes


@dataclass(frozen=True, eq=False)
class Record:
    """One scan (`points`) or one ready-made image (`image`). Missing or unrequested fields hold None."""

    points: Float32[np.ndarray, "n 3"] | None = None
    """Points in the LiDAR frame, in metres: x forward, y left, z up. Some may not be finite."""
    image: Float32[np.ndarray, "h w"] | None = None
    """Image in the orientation of eq. 1 (`image[v, u]`, x to the right, y up), on the scale of counts."""
    labels: Int32[np.ndarray, "..."] | None = None
    """Raw SemanticKITTI ids, one per point or pixel. 0 means an unknown class."""
    labels_file: Path | None = None
    """File of the labels, for error messages."""
    lasers: Int32[np.ndarray, " n"] | None = None
    """Laser number of each point, if the file contains it."""
    name: str = ""
    """Name for error messages: "scan 000052 of sequence 08"."""
    time_field: TimeField | None = None
    """Times of the points as the file states them, if it does."""
    position: Float[np.ndarray, " 3"] | None = None
    """Position in metres, z up."""
    time: float | None = None
    """Time in seconds."""
    mounting: Mounting | None = None
    """Mounting of the sensor. None means gravity-aligned, 1.73 m above the ground."""

    @property
    def upright_points(self) -> Float32[np.ndarray, "n 3"]:
        """Points as seen by a gravity-aligned sensor 1.73 m above the ground. Models use these points."""
        assert self.points is not None
        return self.points if self.mounting is None else self.mounting.level(self.points)

    @property
    def point_times(self) -> Float32[np.ndarray, " n"] | None:
        """Time of each point relative to `time`, in seconds, or None if the file has no times of points.

        Raises ValueError if the times of the points cannot be those of a scan (`TimeField.seconds`).
        """
        if self.time_field is None or self.points is None:
            return None
        valid = np.isfinite(self.points).all(axis=1) & (self.points != 0).any(axis=1)
        with naming(self.name):
            return self.time_field.seconds(valid=valid, scan_time=self.time)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the labels: (n,) for a scan, (h, w) for an image."""
        seen = self.image if self.points is None else self.points[:, 0]
        return () if seen is None else seen.shape

    def classes(self, categories: int) -> Int32[np.ndarray, "..."] | None:
        """Convert the labels to classes.

        Arguments:
          categories: Number of classes (docs/reference/labels.md).

        Returns:
          The class of every point or pixel, or None without labels.

        Raises:
          ValueError: If a label id does not exist. The message names the label file if it is known.
        """
        if self.labels is None:
            return None
        with naming(self.labels_file or self.name):
            return to_classes(self.labels, categories=categories)


ReadRecord = Callable[[Path, Path | None, bool], Record]
"""Reads a record from the file of a scan or image, its label file (None: no labels), and whether to read lasers."""


def scan_record(
    path: Path,
    labels: Path | None = None,
    lasers: bool = False,
    *,
    format: ScanFormat = "auto",
    records: RecordFormat = "kitti",
) -> Record:
    """Read a scan and its labels, each file once.

    Arguments:
      path: File of the scan.
      labels: File of the labels, or None.
      lasers: Whether to return the laser numbers.
      format: Format of the scan file.
      records: Format of a .bin file that "auto" cannot determine from the name.

    Raises:
      ValueError: If a file is malformed, or the number of labels differs from the number of points. Other errors are
        those of `read_scan` and `read_labels`.
    """
    found = read_scan_records(path, format=format, records=records)
    raw = None if labels is None else read_labels(labels, points=len(found.points))
    return found_record(found, lasers=lasers, labels=raw, labels_file=labels)


def found_record(found: Records, *, lasers: bool, **fields: Any) -> Record:
    """Return the record of the points of a scan, with more fields. The lasers are dropped if they are not wanted."""
    return Record(points=found.points, lasers=found.lasers if lasers else None, time_field=found.times, **fields)


def image_record(
    path: Path, labels: Path | None = None, lasers: bool = False, *, read: Callable[[Path], Float32[np.ndarray, "h w"]]
) -> Record:
    """Read a ready-made image with `read`, and its label image. Images have no lasers.

    Errors are those of `read` and `read_label_image`.
    """
    image = read(path)
    return Record(image=image, labels=None if labels is None else read_label_image(labels, shape=image.shape))
