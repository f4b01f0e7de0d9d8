"""Checkpoint directory of a search or a map. A run that was killed resumes from it and ends with the same result.

Everything that takes time is stored: descriptors, images and the comparisons of candidates. A file holds up to `FRAMES`
frames, is named after the first one and is written atomically. Frames after the last file are processed again. A
checkpoint with other settings is deleted. A folder with other files is rejected.
"""

import contextlib
import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import OnBadScan, scan_stream
from sglpr_jax.data.warning import warn
from sglpr_jax.files import alone_in, read_json, replacing, write_json, writing
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.comparison import Fits
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.odometry.bev_odometry import Link
from sglpr_jax.odometry.config import MOTION_DRIFT
from sglpr_jax.registration.bev_search import Peak
from sglpr_jax.retrieval.index import Index
from sglpr_jax.retrieval.reuse import each_mounting, fingerprint, scans_sample
from sglpr_jax.schema import Column, check_columns

KIND = "sglpr-jax unfinished loops"
FORMAT = f"{KIND} 6"
SETTINGS = "settings.json"
ENDING = ".safetensors"
OWN = re.compile(r"[0-9]{6,}\.safetensors|\.([0-9]{6,}\.safetensors|settings\.json)\.[0-9a-f]{32}\.tmp")
"""Names of files of frames, and of temporary files of `files.replacing`."""
COLUMNS = {
    "made_from": Column("uint8", (32,)),
    "shown": Column("int64", ("seen",)),
    "images": Column("uint8", ("seen", "h", "h")),
    "counts": Column("int64", ("n",)),
    "fitted": Column("int64", ("fits",)),
    "fits": Column("float64", ("fits", len(Peak._fields))),
    "links": Column("float64", ("n", len(Link._fields)), finite=False),
}
"""Arrays of a file of frames: `counts` fits a frame. A row of NaN in the links is a missing link."""
FRAMES = 50
"""Number of frames in a file."""


def settings(
    recording: Recording, finder: CandidateFinder, **given: np.ndarray | int | float | str | None
) -> dict[str, Any]:
    """Settings that determine the content of a checkpoint, as JSON values. `given` are further arguments of the run."""
    found = {
        "format": FORMAT,
        "name": recording.name,
        "recording": fingerprint(recording),
        "scans": scans_sample(recording),
        "sensor": None if recording.mounting is None else recording.mounting.fields,
        "gravity": _digest(each_mounting(recording)),
        "times": _digest(recording.times),
        "weights": finder.index.weights_hash,
        "candidates": dataclasses.asdict(finder.config),
        "drift": [dataclasses.asdict(one) for one in (finder.drift, MOTION_DRIFT)],
        "verification": dataclasses.asdict(finder.verification),
        **{name: _digest(value) if isinstance(value, np.ndarray) else value for name, value in given.items()},
    }
    return json.loads(json.dumps(found))


def _digest(values: np.ndarray | None) -> str | None:
    return None if values is None else hashlib.sha256(values.tobytes()).hexdigest()[:16]


@dataclasses.dataclass
class Unfinished:
    """Checkpoint directory of a search or a map."""

    folder: Path
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Settings that determine the content."""
    kept: int = 0
    """Number of stored frames that have been read or written."""
    new: list[tuple[Seen | None, Compared]] = dataclasses.field(default_factory=list)
    """Frames that are not written yet, with their comparisons."""

    @classmethod
    def opened(cls, folder: Path, wanted: dict[str, Any]) -> "Unfinished":
        """Open a folder as checkpoint directory. If it has other settings, warn and delete its checkpoint.

        Raises:
          FileExistsError: If the folder has files that do not belong to a checkpoint.
          WriteError: If the folder cannot be written.
        """
        if other := _other_settings(folder, wanted):
            warn(
                f"{folder}: expected a checkpoint with the same settings, found another {', '.join(other)}; restarting"
            )
            _empty(folder)
        write_json(folder / SETTINGS, wanted)
        return cls(folder, wanted)

    def recall(
        self,
        finder: CandidateFinder,
        mounting_of: Callable[[int], Mounting | None],
        add: Callable[[Seen | None, Compared], None],
        *,
        missing: bool,
    ) -> None:
        """Call `add` with each stored frame and its comparisons.

        Stops at the first file that is missing, damaged or of another recording. With `missing=False`, it also stops at
        the first frame whose scan could not be read.

        Arguments:
          finder: Empty finder, to which `add` adds the frames.
          mounting_of: Mounting of the sensor at a frame.
          add: Function that adds a frame.
          missing: Whether scans may be unreadable.
        """
        while self._path.is_file():
            try:
                frames, more = Index.load_with(self._path, weights_hash=finder.index.weights_hash)
                self._check(frames, more, width=finder.index.width)
            except ValueError:
                return
            shown, images = set(more["shown"].tolist()), iter(more["images"])
            rows = range(self.kept, self.kept + len(frames))
            for row, descriptor, compared in zip(rows, frames.descriptors, compared_of(more), strict=True):
                seen = Seen(np.array(descriptor), next(images), mounting_of(row)) if row in shown else None
                if seen is None and not missing:
                    return
                add(seen, compared)
            self.kept = len(finder)

    def keep(self, seen: Seen | None, compared: Compared, *, index: Index) -> None:
        """Take the next frame, and write a file if it is full. Arguments and errors are those of `write`."""
        self.new.append((seen, compared))
        if len(self.new) >= FRAMES:
            self.write(index)

    def write(self, index: Index) -> None:
        """Write the new frames, if there are any. `index` has the same width and weights. Raises WriteError."""
        if not self.new:
            return
        first, end = self.kept, self.kept + len(self.new)
        frames = Index.empty(index.width, weights_hash=index.weights_hash)
        frames.add(np.stack([np.zeros(index.width) if seen is None else seen.descriptor for seen, _ in self.new]))
        shown = [row for row, (seen, _) in zip(range(first, end), self.new, strict=True) if seen is not None]
        images = [seen.image for seen, _ in self.new if seen is not None]
        stacked = np.stack(images) if images else np.zeros((0, 0, 0), np.uint8)
        more = {"made_from": self._made_from, "shown": np.array(shown, np.int64), "images": stacked}
        content = frames.to_bytes(more | columns([compared for _, compared in self.new]))
        with replacing(self._path) as temporary:
            temporary.write_bytes(content)
        self.kept, self.new = end, []

    def _check(self, frames: Index, more: dict[str, np.ndarray], *, width: int) -> None:
        """Raise ValueError if the content of the next file is invalid or was made from something else."""
        check_columns(more, COLUMNS, n=len(frames))
        if not len(frames) or frames.width != width or not np.array_equal(more["made_from"], self._made_from):
            raise ValueError("expected frames of this recording and these settings, found others")
        first, end = self.kept, self.kept + len(frames)
        counts, query = more["counts"], np.repeat(np.arange(first, end), np.maximum(more["counts"], 0))
        shown_rises = np.all(np.diff(more["shown"], prepend=first - 1, append=end) > 0)
        fitted = more["fitted"]
        if (
            not shown_rises
            or (counts < 0).any()
            or len(query) != len(fitted)
            or np.any((fitted < 0) | (fitted >= query))
        ):
            raise ValueError(f"expected frames {first} to {end - 1} and matches before them, found others")
        if not np.all(np.isfinite(more["links"]).all(axis=1) | np.isnan(more["links"]).all(axis=1)):
            raise ValueError("expected finite links, found others")

    @property
    def _made_from(self) -> UInt8[np.ndarray, "32"]:
        """SHA-256 of the settings and of the number of the next frame."""
        text = json.dumps([self.settings, self.kept], sort_keys=True)
        return np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint8)

    @property
    def _path(self) -> Path:
        """File of the next frames."""
        return self.folder / f"{self.kept:06d}{ENDING}"


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Create and lock a folder. At the end, remove the folder and its new parents if they are empty.

    Raises:
      BlockingIOError: If another process has locked the folder.
      NotADirectoryError: If the path leads through a file.
    """
    there = next(one for one in (folder, *folder.parents) if one.exists())
    if not there.is_dir():
        raise NotADirectoryError(f"{there}: expected a folder to write into, found a file")
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    with writing(folder, *folder.parents):
        folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                for one in made or [folder]:
                    one.rmdir()


def remove(folder: Path) -> None:
    """Delete the checkpoint in a folder, and the folder if it is then empty."""
    _empty(folder)
    with contextlib.suppress(OSError):
        folder.rmdir()


def _other_settings(folder: Path, wanted: dict[str, Any]) -> list[str]:
    """Names of settings that differ from those of a checkpoint, or "format" if it has none. Errors as in `opened`."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return []
    try:
        found = read_json(folder / SETTINGS)
        ours = found["format"].startswith(KIND)
    except (ValueError, OSError, LookupError, TypeError, AttributeError):
        ours = False
    if ours:
        return [name for name, value in wanted.items() if found.get(name) != value]
    _check_own(folder)
    return ["format"]


def _check_own(folder: Path) -> None:
    """Raise FileExistsError if a folder holds anything but files of frames and temporary files."""
    others = sorted(path.name for path in folder.iterdir() if not _is_own(path))
    if others:
        raise FileExistsError(
            f"{folder}: expected a new folder, an empty one or a checkpoint directory, found {others[0]}"
            f"{' and more' if len(others) > 1 else ''}"
        )


def _empty(folder: Path) -> None:
    (folder / SETTINGS).unlink(missing_ok=True)  # first, so that a killed run leaves no settings
    for path in folder.glob("*"):
        if _is_own(path):
            path.unlink()


def _is_own(path: Path) -> bool:
    return OWN.fullmatch(path.name) is not None and path.is_file()


def columns(compared: Sequence[Compared]) -> dict[str, np.ndarray]:
    """Convert the comparisons of some frames to arrays: their fits, in order, and the link of each frame."""
    counts = [len(one.fits.frames) for one in compared]
    links = [[np.nan] * len(Link._fields) if one.link is None else [float(v) for v in one.link] for one in compared]
    fits = [np.stack(one.fits.peaks, axis=1) for one in compared]
    return {
        "counts": np.array(counts, np.int64),
        "fitted": np.concatenate([np.zeros(0, np.int64), *(one.fits.frames for one in compared)]),
        "fits": np.concatenate([np.zeros((0, len(Peak._fields))), *fits]),
        "links": np.array(links).reshape(-1, len(Link._fields)),
    }


def compared_of(columns: dict[str, np.ndarray]) -> list[Compared]:
    """Convert arrays of `columns` to the comparisons of the frames."""
    ends = np.cumsum(columns["counts"])[:-1]
    parts = zip(np.split(columns["fitted"], ends), np.split(columns["fits"], ends), columns["links"], strict=True)
    return [
        Compared(Fits(frames, Peak(*fits.T)), None if np.isnan(link).all() else Link(*link))
        for frames, fits, link in parts
    ]


def add_scans(
    recording: Recording,
    finder: CandidateFinder,
    add: Callable[[Seen | None, Compared | None], None],
    *,
    rows: Iterable[int] | None = None,
    kept_in: Path | str | None,
    on_bad_scan: OnBadScan | None,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
    **given: np.ndarray | int | float | str | None,
) -> None:
    """Add the frames of a checkpoint directory, then read, describe and add further scans.

    Arguments:
      recording: The scans.
      finder: Finder without frames.
      add: Function that adds the next frame to the finder. It receives descriptor and image, or None for a bad scan,
        and the comparisons of a frame of the checkpoint.
      rows: Rows of the scans that the checkpoint lacks, by default all further rows. A row is taken after the previous
        scan was added.
      kept_in: Checkpoint directory, or None.
      on_bad_scan: See `scan_stream`. Without it, the checkpoint ends at the first bad scan.
      should_stop: See `scan_stream`.
      on_progress: See `scan_stream`.
      given: Further arguments that determine the content of a checkpoint (`settings`).

    Raises the errors of `Unfinished.opened` and `scan_stream`.
    """
    kept = None if kept_in is None else Unfinished.opened(Path(kept_in), settings(recording, finder, **given))
    if kept is not None:
        mounting_of = recording.mounting_of if rows is None else lambda frame: recording.mounting  # unused by a map
        kept.recall(finder, mounting_of, add, missing=on_bad_scan is not None)
    if len(finder):
        on_progress(len(finder))
    left = range(len(finder), len(recording)) if rows is None else rows
    options = {"on_bad_scan": on_bad_scan, "should_stop": should_stop, "on_progress": on_progress}
    for _, seen in scan_stream(recording, lambda row, record: finder.seen(record), rows=left, **options):
        add(seen, None)
        if kept is not None:
            kept.keep(seen, finder.compared, index=finder.index)
    if kept is not None:
        kept.write(finder.index)
