"""`Recording`: the scans of one drive as a reader of a dataset returns them."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from sglpr_jax.data.mounting import Mounting, upright_from_lidar
from sglpr_jax.data.scan import Scan

ReadScan = Callable[[Path, Path | None], Scan]
"""Reads a scan from the file of its points or image, and its label file (None: no labels)."""
ReadUps = Callable[[], tuple[Float[np.ndarray, "n 3"], str] | None]
"""Returns the direction of up in the LiDAR frame at each scan (NaN where unknown) and a description of its source, or
None if the IMU does not measure gravity."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Scans or ready-made images in the order of recording, with positions, times and labels if known.

    Recordings from files, packs, corruptions and the simulator differ only in `read`.

    Example:
      recording = open_recording(root, "08")
      scan = recording.scan(0)  # points (n, 3), labels (n,) or None
    """

    name: str
    ids: tuple[str, ...]
    """Name of each scan, the stem of its file: "000052"."""
    paths: tuple[Path, ...]
    """Files of the scans or images. The scans of a bag have names instead, and the bag is in `containers`."""
    read: ReadScan
    """Function that reads a scan from its files."""
    positions: Float[np.ndarray, "n 3"] | None = None
    """Positions in metres, z up, or None if unknown."""
    times: Float[np.ndarray, " n"] | None = None
    """Times in seconds, or None if unknown."""
    pose_source: str | None = None
    """Source of the positions, or None."""
    world: str = ""
    """Name of the world whose frame the positions have, such as a dataset with one frame for all days. Recordings of
    one world may show the same places. Empty: the recording has a frame of its own."""
    label_paths: tuple[Path | None, ...] = ()
    """Label file of each scan or image, None if it has no labels. Empty if the recording has no labels."""
    resolution_m: float | None = None
    """Edge of a pixel of ready-made images, in metres. None for scans."""
    on_disk: bool = True
    """Whether each scan is a file that `read` reads unchanged. False for bags, point cloud maps, and packed, changed or
    simulated recordings."""
    mounting: Mounting | None = None
    """Height and tilt of the sensor. None means gravity-aligned, 1.73 m above the ground."""
    mountings: tuple[Mounting, ...] | None = None
    """Mounting at each scan of a sensor that tilts. None means that `mounting` holds for all scans."""
    world_from_lidar: Float[np.ndarray, "n 4 4"] | None = None
    """Poses of the LiDAR: those of a bag in the frame of its messages, if these contain rotations, or those of a point
    cloud map. None for other layouts."""
    read_ups: ReadUps | None = None
    """Function that reads up at each scan from an IMU. None without an IMU, and when the gravity is known."""
    found: tuple[str, ...] = ()
    """Notes of the reader: the format of the scans, the mounting of the sensor, ignored files."""
    rows: Int[np.ndarray, " n"] | None = None
    """Row of each scan in the whole recording, if scans are left out. None means that no scan is left out."""
    containers: tuple[Path, ...] = ()
    """Files that contain all scans, such as those of a bag. Empty if each scan is a file."""

    def __post_init__(self):
        if len(set(self.ids)) < len(self.ids):
            repeated = next(name for name in self.ids if self.ids.count(name) > 1)
            raise ValueError(f"sequence {self.name}: expected a unique id for each scan, found {repeated!r} twice")
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
        """Number of each scan in the whole recording, from 0. Scans that were left out (`rows`) are counted."""
        return np.arange(len(self)) if self.rows is None else self.rows

    @property
    def description(self) -> tuple[str, ...]:
        """Lines for the user: number of scans, notes of the reader, and times, poses and extent of the trajectory."""
        times = "none" if self.times is None else f"over {np.ptp(self.times):.1f} s"
        poses = self.pose_source or "none"
        if self.positions is not None and len(self):
            x, y, z = np.ptp(self.positions, axis=0)
            poses += f", over {x:.0f} x {y:.0f} m and {z:.0f} m of height"
        kind = "images" if self.has_images else "scans"
        return (f"{self.name}: {len(self)} {kind}", *self.found, f"times: {times}; poses: {poses}")

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
        """Read options that are strings, such as the format of the scans. They identify what `read` returns."""
        options = getattr(self.read, "keywords", {})
        return {name: value for name, value in options.items() if isinstance(value, str)}

    def scan(self, i: int, *, labels: bool = True) -> Scan:
        """Read scan or image `i`, each of its files once, with or without labels."""
        return self.read_row(i, self.label_paths[i] if labels and self.label_paths else None)

    def read_row(self, i: int, label_path: Path | None) -> Scan:
        """Read scan or image `i` with the labels of a file, or without labels, and add what is known of it."""
        return dataclasses.replace(
            self.read(self.paths[i], label_path),
            name=f"scan {self.ids[i]} of sequence {self.name}",
            time=None if self.times is None else float(self.times[i]),
            mounting=self.mounting_of(i),
        )

    def with_note(self, note: str, **fields: Any) -> "Recording":
        """Return the recording with one more note in `found`, and with other values of some `fields`."""
        return dataclasses.replace(self, found=(*self.found, note), **fields)

    def with_reader(
        self,
        read_row: Callable[[int, Path | None], Scan],
        *,
        options: Mapping[str, str] | None = None,
        **fields: Any,
    ) -> "Recording":
        """Return a recording whose scans are computed from those of this recording, such as corrupted or scaled ones.

        Arguments:
          read_row: Function of the row and the label file, as `Recording.read_row`.
          options: Read options that identify the change, in addition to those of this recording.
          fields: Other fields that change.
        """
        row_of = {path: row for row, path in enumerate(self.paths)}

        def read(path: Path, label_path: Path | None, **options: str) -> Scan:
            return read_row(row_of[path], label_path)

        read_options = {**self.read_options, **(options or {})}  # the keywords of the partial, unused by `read`
        return dataclasses.replace(self, read=partial(read, **read_options), on_disk=False, **fields)

    def mounting_of(self, i: int) -> Mounting | None:
        """Mounting of the sensor at scan `i`."""
        return self.mounting if self.mountings is None else self.mountings[i]

    @property
    def uprights(self) -> Float[np.ndarray, "n 4 4"]:
        """Transform from the LiDAR frame to the gravity-aligned frame (`upright_from_lidar`) at each scan."""
        mountings = [self.mounting] if self.mountings is None else self.mountings
        return np.broadcast_to([upright_from_lidar(mounting) for mounting in mountings], (len(self), 4, 4))

    def require_scans(self, expected: str = "scans") -> None:
        """Raise ValueError if the recording has ready-made images. `expected` says why it needs scans."""
        if self.has_images:
            raise ValueError(f"sequence {self.name}: expected {expected}, found ready-made images")

    def points(self, i: int) -> Float32[np.ndarray, "n 3"]:
        """Read the points of scan `i`. Raises ValueError if the recording contains images."""
        self.require_scans()
        return self.scan(i, labels=False).cloud

    def image(self, i: int) -> Float32[np.ndarray, "h w"]:
        """Read image `i`. Raises ValueError if the recording contains scans."""
        image = self.scan(i, labels=False).image
        if image is None:
            raise ValueError(f"sequence {self.name}: expected ready-made images, found scans")
        return image

    def labels(self, i: int) -> Int32[np.ndarray, "..."] | None:
        """Read the labels of scan or image `i`. This also reads the scan, to check that the labels fit."""
        return self.scan(i).labels if self.labelled[i] else None
