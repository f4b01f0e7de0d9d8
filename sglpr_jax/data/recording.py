"""Scans and recordings: what a reader returns, and how a scan is read from its files."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.clouds import Records, TimeField
from sglpr_jax.data.formats.png import read_label_image
from sglpr_jax.data.formats.scan_files import read_labels, read_scan_records
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.files import naming
from sglpr_jax.labels import to_classes

FARTHEST_M = 300.0
"""Limit of the largest coordinate of a point, in metres. No vehicle LiDAR has half of its points beyond it."""


def check_cloud(points: Float32[np.ndarray, "n _"], *, name: str = "") -> None:
    """Check that a point cloud shows a place.

    Arguments:
      points: Points in the sensor frame, in metres.
      name: Name of the scan for the error message.

    Raises:
      ValueError: If the array is not (n, 3), no point is finite, all points are at the sensor, or half of the points
        are beyond `FARTHEST_M`.
    """
    where = f"{name}: " if name else ""
    if points.shape[1] != 3:
        raise ValueError(f"{where}expected points (n, 3) with x, y and z only, found shape {points.shape}")
    x, y, z = np.abs(points.T)  # Column by column: a reduction over the last axis takes ten times as long.
    largest = np.maximum(np.maximum(x, y), z)  # Not finite if any coordinate is not finite.
    near = largest <= FARTHEST_M
    if 2 * np.count_nonzero(near) > len(points) and (near & (largest > 0)).any():
        return  # Nearly all scans end here.
    largest = largest[np.isfinite(largest)]
    if not len(largest):
        raise ValueError(f"{where}expected finite points, found none among {len(points)}")
    if not largest.any():
        raise ValueError(f"{where}expected points around the sensor, found all {len(largest)} points at (0, 0, 0)")
    half_are_beyond = 2 * np.count_nonzero(largest > FARTHEST_M) >= len(largest)
    if half_are_beyond and np.median(largest) > FARTHEST_M:
        raise ValueError(
            f"{where}expected metres, with most points within {FARTHEST_M:g}, found half of the points beyond"
            f" {np.median(largest):.4g} and the farthest at {largest.max():.4g}; are the coordinates in millimetres,"
            " or is the format of the scan wrong (--format, for .bin files)?"
        )


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


ReadUps = Callable[[], tuple[Float[np.ndarray, "n 3"], str] | None]
"""Reads up in the LiDAR frame at each scan, NaN where unknown, and its source in words; None if there is no gravity."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Scans or ready-made images in the order of recording, with positions, times and labels if known.

    Recordings from files, packs, corruptions and the simulator differ only in `read`.

    Example:
      recording = open_recording(root, "08")
      record = recording.record(0)  # points (n, 3), labels (n,) or None
    """

    name: str
    ids: tuple[str, ...]
    """Name of each scan, the stem of its file: "000052"."""
    positions: Float[np.ndarray, "n 3"] | None
    """Positions in metres, z up, or None if unknown."""
    times: Float[np.ndarray, " n"] | None
    """Times in seconds, or None if unknown."""
    pose_source: str | None
    """Source of the positions, or None."""
    paths: tuple[Path, ...]
    """Files of the scans or images. The scans of a bag have names instead, and the bag is in `containers`."""
    read: ReadRecord
    """Function that reads a record from its files."""
    label_paths: tuple[Path | None, ...] = ()
    """Label file of each scan or image, None if it has no labels. Empty if the recording has no labels."""
    resolution_m: float | None = None
    """Edge of a pixel of ready-made images, in metres. None for scans."""
    on_disk: bool = True
    """Whether `read` returns the content of the files. False for packed, corrupted and simulated recordings."""
    mounting: Mounting | None = None
    """Height and tilt of the sensor. None means gravity-aligned, 1.73 m above the ground."""
    mountings: tuple[Mounting, ...] | None = None
    """Mounting at each scan of a sensor that tilts. None means that `mounting` holds for all scans."""
    world_from_lidar: Float[np.ndarray, "n 4 4"] | None = None
    """Poses of the LiDAR in the frame of a bag's messages, if these contain rotations. None for other layouts."""
    read_ups: ReadUps | None = None
    """Function that reads up at each scan from an IMU. None without an IMU, and when the gravity is known."""
    found: tuple[str, ...] = ()
    """What the reader found, in words: the format of the scans and the ignored files."""
    rows: Int[np.ndarray, " n"] | None = None
    """Row of each scan in the whole recording, if scans are left out. None means that no scan is left out."""
    containers: tuple[Path, ...] = ()
    """Files that contain all scans, such as those of a bag. Empty if each scan is a file."""

    def __post_init__(self):
        """Raise ValueError if two scans have the same id, or if a field does not have one entry per scan."""
        if len(set(self.ids)) < len(self.ids):
            twice = next(name for name in self.ids if self.ids.count(name) > 1)
            raise ValueError(f"sequence {self.name}: expected a unique id for each scan, found {twice!r} twice")
        for name in ("paths", "positions", "times", "label_paths", "world_from_lidar", "rows", "mountings"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self) and not (name == "label_paths" and not values):
                raise ValueError(
                    f"sequence {self.name}: expected {len(self)} {name}, one per scan, found {len(values)}"
                )

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def numbers(self) -> Int[np.ndarray, " n"]:
        """Number of each scan in the whole recording, from 0. Scans that are left out have numbers, too."""
        return np.arange(len(self)) if self.rows is None else self.rows

    @property
    def description(self) -> tuple[str, ...]:
        """Description in words, one line each: number of scans, their format, times and poses."""
        times = "none" if self.times is None else f"over {np.ptp(self.times):.1f} s"
        return (
            f"{self.name}: {len(self)} {'images' if self.has_images else 'scans'}",
            *self.found,
            f"times: {times}; poses: {self.pose_source or 'none'}{self._extent}",
        )

    @property
    def _extent(self) -> str:
        """Extent of the positions in words. A large height indicates a wrong frame."""
        if self.positions is None or not len(self):
            return ""
        x, y, z = np.ptp(self.positions, axis=0)
        return f", over {x:.0f} x {y:.0f} m and {z:.0f} m of height"

    @property
    def has_images(self) -> bool:
        """Whether the recording contains ready-made images instead of scans."""
        return self.resolution_m is not None

    @property
    def labelled(self) -> tuple[bool, ...]:
        """Whether each scan or image has labels."""
        return tuple(path is not None for path in self.label_paths) or (False,) * len(self)

    @property
    def has_labels(self) -> bool:
        """Whether any scan or image has labels."""
        return any(self.labelled)

    @property
    def read_options(self) -> dict[str, str]:
        """Read options that are strings, such as the format of the scans."""
        options = getattr(self.read, "keywords", {})
        return {name: value for name, value in options.items() if isinstance(value, str)}

    def record(self, i: int, *, labels: bool = True, lasers: bool = False) -> Record:
        """Read scan or image `i`, each of its files once.

        Arguments:
          i: Index of the scan or image.
          labels: Whether to read the labels.
          lasers: Whether to return the laser numbers.

        Raises:
          FileNotFoundError: If a file does not exist.
          ValueError: If a file is malformed or the labels do not fit.
        """
        label_path = self.label_paths[i] if labels and self.label_paths else None
        return dataclasses.replace(
            self.read(self.paths[i], label_path, lasers),
            name=f"scan {self.ids[i]} of sequence {self.name}",
            time=None if self.times is None else float(self.times[i]),
            mounting=self.mounting_of(i),
        )

    def mounting_of(self, i: int) -> Mounting | None:
        """Mounting of the sensor at scan `i`."""
        return self.mounting if self.mountings is None else self.mountings[i]

    def points(self, i: int) -> Float32[np.ndarray, "n 3"]:
        """Read the points of scan `i`. Raises ValueError if the recording contains images."""
        points = self.record(i, labels=False).points
        if points is None:
            raise ValueError(f"sequence {self.name}: expected scans, found ready-made images")
        return points

    def image(self, i: int) -> Float32[np.ndarray, "h w"]:
        """Read image `i`. Raises ValueError if the recording contains scans."""
        image = self.record(i, labels=False).image
        if image is None:
            raise ValueError(f"sequence {self.name}: expected ready-made images, found scans")
        return image

    def labels(self, i: int) -> Int32[np.ndarray, "..."] | None:
        """Read the labels of scan or image `i`. This also reads the scan, to check that the labels fit; see
        `record`."""
        return self.record(i).labels if self.labelled[i] else None
