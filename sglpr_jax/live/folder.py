"""A folder into which another program writes scans, one file each. Every scan is taken once it is complete."""

import bisect
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseFormat, RecordFormat, TimeUnit
from sglpr_jax.data.formats.bin_records import unusual_record
from sglpr_jax.data.formats.pose_files import CAMERA_FROM_LIDAR, numbers_of, quaternion_poses
from sglpr_jax.data.formats.scan_files import ARRAY_ENDINGS, ENDINGS, named_format, scan_of_file
from sglpr_jax.data.poses import BEYOND_S, pose_at, poses_of
from sglpr_jax.data.readers.listing import files_in
from sglpr_jax.data.times import EPOCH, PER_SECOND
from sglpr_jax.live.node_messages import LiveFrame, Report
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.sources_and_sinks import Taken

LOOK_S = 0.05
"""Time between two looks at the folder, in seconds."""
QUIET_S = 2.0
"""Age of a file, in seconds, from which it is complete at the first look."""
POSE_S = 1.0
"""Maximum age of a scan that waits for its pose, in seconds."""
AROUND = 25
"""Number of poses before and after a time between which a pose is interpolated."""


class FolderSource:
    """Scans in the order of their names. A scan is complete if its size is the same at two looks."""

    dropped = 0
    """Scans are never dropped: their files stay until they are read."""

    def __init__(self, root: Path, options: LiveOptions, report: Report, taken: Taken):
        """Begin after the last scan in the folder that is `taken`. Raises ValueError if --poses cannot grow."""
        self._root, self._options, self._report = root, options, report
        self._records: RecordFormat | None = None
        """Format of .bin files whose name does not define it, by the content of the first one."""
        self._sizes: dict[Path, int] = {}
        """Size of each waiting file at the last look."""
        self._waiting: list[Path] = []
        self._listed_ns = 0
        """Time of the last change of the folder that was listed, in nanoseconds."""
        self._closed = False
        paths = self._list()
        last_taken = max((row for row, path in enumerate(paths) if taken(_name(path))), default=-1)
        self._done = set(paths[: last_taken + 1])
        self._poses = None
        if options.poses is not None:
            self._poses = GrowingPoses(options.poses, options.pose_format, options.time_unit)

    def frames(self) -> Iterator[LiveFrame | None]:
        """Yield scans as they are completed. Never ends."""
        while not self._closed:
            self._look()
            path = self._next_complete()
            if path is None:
                time.sleep(LOOK_S)
                yield None
                continue
            received = time.monotonic()
            self._done.add(path)
            yield from self._frame(path, received)

    def close(self) -> None:
        self._closed = True

    def _list(self) -> list[Path]:
        """Files of scans in the folder, in order."""
        return list(files_in(self._root, *ENDINGS) or files_in(self._root, *ARRAY_ENDINGS))

    def _look(self) -> None:
        """List the folder again if a file was added."""
        try:
            changed_ns = self._root.stat().st_mtime_ns
            if changed_ns != self._listed_ns or time.time_ns() - changed_ns <= QUIET_S * 1e9:
                self._waiting = [path for path in self._list() if path not in self._done]
                self._listed_ns = changed_ns
        except OSError as error:
            self._report("folder", f"{self._root}: expected a folder of scans, found none ({error.strerror})")

    def _next_complete(self) -> Path | None:
        """Remove and return the first waiting scan, if it is complete."""
        if not self._waiting:
            return None
        path = self._waiting[0]
        try:
            file = path.stat()
        except OSError:  # it was removed or renamed
            self._waiting.pop(0)
            return None
        is_old = time.time() - file.st_mtime > QUIET_S
        if is_old or file.st_size == self._sizes.get(path, 0) > 0:
            self._sizes.pop(path, None)
            return self._waiting.pop(0)
        self._sizes[path] = file.st_size
        return None

    def _frame(self, path: Path, received: float) -> Iterator[LiveFrame | None]:
        """Read a scan and wait for its pose. A scan that cannot be read is reported."""
        try:
            if self._records is None and self._options.format == "auto" and named_format(path) is None:
                self._records = unusual_record([path]) or "kitti"
            scan = scan_of_file(path, format=self._options.format, records=self._records or "kitti")
            stamp, written = _time_in_name(path), path.stat().st_mtime
        except (ValueError, OSError, ImportError) as error:
            return self._report("scan", f"a scan is left out: {error}")
        pose, row = None, len(self._done) - 1
        if self._poses is not None:
            while (pose := self._pose(self._poses, row, stamp)) is None and time.time() - written < POSE_S:
                time.sleep(LOOK_S)
                yield None
        yield LiveFrame(
            dataclasses.replace(scan, name=_name(path)), written if stamp is None else stamp, pose, received
        )

    def _pose(self, poses: "GrowingPoses", row: int, stamp: float | None) -> Float[np.ndarray, "4 4"] | None:
        """Pose of a scan, or None if the file does not have it yet. An invalid line is reported."""
        try:
            poses.look()
            return poses.of(row, stamp)
        except ValueError as error:
            return self._report("poses", f"a pose is left out: {error}")


def _name(path: Path) -> str:
    return str(path.resolve())


def _time_in_name(path: Path) -> float | None:
    """Time in seconds that the name of a file states, such as 1690000000.25.pcd, or None."""
    try:
        seconds = float(path.name[: -len(path.suffix)])
    except ValueError:
        return None
    return seconds if "." in path.stem and seconds > EPOCH else None


class GrowingPoses:
    """Reads new whole lines of a file at each look. The file need not exist yet."""

    def __init__(self, path: Path, format: PoseFormat, time_unit: TimeUnit):
        """Begin with nothing read. Raises ValueError if the format cannot be that of a growing file."""
        if format == "csv":
            raise ValueError(f"{path}: expected poses as tum, kitti or lidar, found csv")
        self._path, self._format, self._unit = path, format, PER_SECOND[time_unit]
        self._read = self._line = 0
        """Number of bytes and of lines read so far."""
        self._times: list[float] = []
        """Time of each line, in seconds, in order. 0 in files without times."""
        self._poses: list[np.ndarray | None] = []
        """Pose (4, 4) of each line. None for an invalid line."""

    def look(self) -> None:
        """Read the lines that were added since the last look.

        Raises ValueError if one of them is invalid. The other ones are read; the scan of that line has no pose.
        """
        if not self._path.is_file():
            return
        with self._path.open("rb") as file:
            file.seek(self._read)
            new = file.read()
        whole_lines = new[: new.rfind(b"\n") + 1]
        self._read += len(whole_lines)
        first_error = None
        for line in whole_lines.decode(errors="replace").splitlines():
            self._line += 1
            try:
                if line.strip() and not line.startswith("#"):
                    self._add(line.split(), f"{self._path}, line {self._line}")
            except ValueError as error:
                first_error = first_error or error
        if first_error is not None:
            raise first_error

    def of(self, row: int, time: float | None) -> Float[np.ndarray, "4 4"] | None:
        """Pose of a scan, or None if the file does not have it yet.

        Files with a line for each scan, and scans without times, need `row`. Tum files need the time in seconds.
        """
        if time is None or self._format not in ("auto", "tum"):
            return self._poses[row] if row < len(self._poses) else None
        middle = bisect.bisect_left(self._times, time)
        near = range(max(middle - AROUND, 0), min(middle + AROUND, len(self._poses)))
        posed = [(self._times[i], pose) for i in near if (pose := self._poses[i]) is not None]
        if len(posed) < 2 or posed[-1][0] < time - BEYOND_S:
            return None
        stamps, poses = zip(*posed, strict=True)
        return pose_at(np.array(stamps), np.stack(poses), time)

    def _add(self, words: list[str], where: str) -> None:
        if self._format == "auto" and len(words) == 12:
            raise ValueError(
                f"{where}: expected the axes of 12 numbers a line, found none; pass --pose-format kitti or lidar"
            )
        self._times.append(self._times[-1] if self._times else 0.0)
        self._poses.append(None)  # also if the line is invalid: the next line is that of the next scan
        if self._format in ("auto", "tum"):
            numbers = numbers_of(words, columns=8, where=where)
            pose = quaternion_poses(self._path, numbers[None, 1:4], numbers[None, 4:])[0]
            self._times[-1] = float(numbers[0] / self._unit)
        else:
            matrix = numbers_of(words, columns=12, where=where).reshape(1, 3, 4)
            pose = poses_of(matrix[:, :, 3], matrix[:, :, :3])[0]
            pose = CAMERA_FROM_LIDAR.T @ pose @ CAMERA_FROM_LIDAR if self._format == "kitti" else pose
        self._poses[-1] = pose


def open_source(where: str, options: LiveOptions, report: Report, taken: Taken) -> FolderSource:
    """Open the folder `where`. Raises FileNotFoundError if it does not exist."""
    root = Path(where)
    if not where or not root.is_dir():
        raise FileNotFoundError(f"folder:{where}: expected a folder, into which scans are written, found none")
    return FolderSource(root, options, report, taken)
