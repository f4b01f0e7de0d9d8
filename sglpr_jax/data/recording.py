"""What every reader returns: the scans, or ready-made BEV images, of one sequence. A file is read when asked for."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int32

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import ReadRecord, Record


@dataclass(frozen=True, eq=False)
class Recording:
    """Scans, or ready-made images, in the order they were taken, with positions, times and labels where known.

    One type for what lies in files and for what is packed, corrupted or simulated: they differ in `read` alone.

    Example:
      recording = open_recording(root, "08")
      record = recording.record(0)  # points (n, 3), labels (n,) or None
    """

    name: str
    ids: tuple[str, ...]
    """The files' stems: "000052"."""
    positions: Float[np.ndarray, "n 3"] | None
    """Metres, z up, or None where nothing tells them."""
    times: Float[np.ndarray, " n"] | None
    """Seconds, or None."""
    pose_source: str | None
    """Where the positions come from."""
    paths: tuple[Path, ...]
    """The files of the scans or images."""
    read: ReadRecord
    """How a record is read from its files."""
    label_paths: tuple[Path | None, ...] = ()
    """The files of labels: None for each scan or image without; empty for none at all."""
    resolution_m: float | None = None
    """The edge of a pixel of ready-made images, in metres; None for scans."""
    on_disk: bool = True
    """Whether `read` gives what the files hold: not where it is packed, corrupted or simulated."""
    mounting: Mounting | None = None
    """The sensor's height and tilt, where they are not those that models know; None: as the points are."""
    world_from_lidar: Float[np.ndarray, "n 4 4"] | None = None
    """Poses of the LiDAR, where a bag's messages tell rotations too, in the frame of these; None of other layouts."""
    found: tuple[str, ...] = ()
    """What the reader found, for a person: the format of the scans, what was left aside."""

    def __post_init__(self):
        """Raise ValueError where two scans have one id, or something is not there once for each scan."""
        if len(set(self.ids)) < len(self.ids):
            twice = next(name for name in self.ids if self.ids.count(name) > 1)
            raise ValueError(f"sequence {self.name}: expected an id of its own for each scan, found {twice!r} twice")
        for name in ("paths", "positions", "times", "label_paths", "world_from_lidar"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self) and not (name == "label_paths" and not values):
                raise ValueError(f"sequence {self.name}: expected {len(self)} {name}, one a scan, found {len(values)}")

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def description(self) -> tuple[str, ...]:
        """Everything that was found, a line each: how many scans, their format, times, poses and their frame."""
        times = "none" if self.times is None else f"over {np.ptp(self.times):.1f} s"
        return (
            f"{self.name}: {len(self)} {'images' if self.has_images else 'scans'}",
            *self.found,
            f"times: {times}; poses: {self.pose_source or 'none'}{self._extent}",
        )

    @property
    def _extent(self) -> str:
        """How far the positions reach, in words: a wrong frame shows in the height."""
        if self.positions is None or not len(self):
            return ""
        x, y, z = np.ptp(self.positions, axis=0)
        return f", over {x:.0f} x {y:.0f} m and {z:.0f} m of height"

    @property
    def has_images(self) -> bool:
        """Whether these are ready-made images; else they are scans."""
        return self.resolution_m is not None

    @property
    def labelled(self) -> tuple[bool, ...]:
        """Which scans or images have labels."""
        return tuple(path is not None for path in self.label_paths) or (False,) * len(self)

    @property
    def has_labels(self) -> bool:
        """Whether any scan or image has labels."""
        return any(self.labelled)

    @property
    def read_options(self) -> dict[str, str]:
        """The options with which files are read that can be named: the format of the scans, say."""
        options = getattr(self.read, "keywords", {})
        return {name: value for name, value in options.items() if isinstance(value, str)}

    def record(self, i: int, *, labels: bool = True, lasers: bool = False) -> Record:
        """Read scan or image `i`, each of its files once; without `labels` the file of labels is left alone.

        Raises FileNotFoundError, and ValueError where a file is malformed or the labels do not fit.
        """
        label_path = self.label_paths[i] if labels and self.label_paths else None
        return dataclasses.replace(
            self.read(self.paths[i], label_path, lasers),
            name=f"scan {self.ids[i]} of sequence {self.name}",
            position=None if self.positions is None else self.positions[i],
            time=None if self.times is None else float(self.times[i]),
            mounting=self.mounting,
        )

    def points(self, i: int) -> Float32[np.ndarray, "n 3"]:
        """Read the points of scan `i`; ValueError where these are images."""
        points = self.record(i, labels=False).points
        if points is None:
            raise ValueError(f"sequence {self.name}: expected scans, found ready-made images")
        return points

    def image(self, i: int) -> Float32[np.ndarray, "h w"]:
        """Read image `i`; ValueError where these are scans."""
        image = self.record(i, labels=False).image
        if image is None:
            raise ValueError(f"sequence {self.name}: expected ready-made images, found scans")
        return image

    def labels(self, i: int) -> Int32[np.ndarray, "..."] | None:
        """Read the labels of scan or image `i`, which is read too, since they must fit; `record` has both."""
        return self.record(i).labels if self.labelled[i] else None
