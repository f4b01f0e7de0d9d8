"""Source of scans from a folder into which another program writes them, one file each, and its file of poses."""

import bisect
import dataclasses
import os
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TypeGuard

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseFormat, RecordFormat, TimeUnit
from sglpr_jax.data.formats.bin_records import detect_format_unless_kitti
from sglpr_jax.data.formats.pose_files import matrix_poses, parse_numbers, quaternion_poses
from sglpr_jax.data.formats.scan_files import format_by_name, scan_names, scan_of_file
from sglpr_jax.data.poses import BEYOND_S, SAME_S, pose_at
from sglpr_jax.data.readers.listing import in_natural_order
from sglpr_jax.data.times import EPOCH, PER_SECOND
from sglpr_jax.files import in_short
from sglpr_jax.live.data_types import LiveFrame, Report
from sglpr_jax.live.options import LiveOptions

POLL_S = 0.05
"""Time between two looks at the folder, in seconds."""
COMPLETE_AFTER_S = 2.0
"""Age of a file, in seconds, from which it is complete without a second look."""
MAX_POSE_WAIT_S = 1.0
"""Maximum time that a scan waits for its pose, in seconds. It counts from the date of the file or, if that is in the
future, from the time at which the scan was taken."""
NEAR_POSES = 25
"""Number of poses before and after a time that are searched for those to interpolate."""
KEPT_POSES = 1000
"""Number of poses before the last requested one that are kept, for scans that come out of order."""


class FolderSource:
    """Scans in the order of their names. A scan is complete if its size is the same at two looks at the folder."""

    dropped = 0
    """Scans are never dropped: their files stay until they are read."""

    def __init__(self, root: Path, options: LiveOptions, report: Report, map_names: Collection[str]):
        """Begin after the last scan whose name is in `map_names`.

        Raises ValueError if the poses are in a csv file, or if a scan of the map was removed and the line of a pose is
        the number of its scan.
        """
        self._root, self._options, self._report = root, options, report
        self._bin_layout: RecordFormat | None = None
        """Format of .bin files whose names do not state it, detected in the content of the first one."""
        self._sizes: dict[Path, int] = {}  # size of each waiting file at the last look, in bytes
        self._waiting: list[Path] = []  # files that were not taken, in order
        self._listed_change_ns = 0  # modification time of the folder at its last final listing, in nanoseconds
        self._closed = False
        self._taken = set[str]()  # names of the files
        paths = self._list()
        names = [_scan_name(path) for path in paths]
        last_taken = max((row for row, name in enumerate(names) if name in map_names), default=-1)
        self._taken.update(path.name for path in paths[: last_taken + 1])
        self._poses = None
        if options.poses is not None:
            self._poses = GrowingPoses(options.poses, options.pose_format, options.time_unit)
            _check_not_removed(root, set(map_names).difference(names), self._poses)

    def frames(self) -> Iterator[LiveFrame | None]:
        """Yield scans as they are completed. Never ends."""
        while not self._closed:
            self._update_waiting()
            path = self._next_complete()
            if path is None:
                time.sleep(POLL_S)
                yield None
                continue
            received = time.monotonic()
            self._taken.add(path.name)
            yield from self._read_frame(path, received)

    def close(self) -> None:
        self._closed = True

    def _list(self) -> list[Path]:
        """Files of scans in the folder that were not taken, in order."""
        with os.scandir(self._root) as entries:
            new_names = set(scan_names(entry.name for entry in entries)) - self._taken
        return list(in_natural_order(self._root / name for name in new_names))

    def _update_waiting(self) -> None:
        """List the folder again if no file waits, until a listing is final: `COMPLETE_AFTER_S` after the last change,
        so that no later file has the same time of change."""
        if self._waiting:
            return
        try:
            changed_ns = self._root.stat().st_mtime_ns
            if changed_ns != self._listed_change_ns:
                is_final = time.time_ns() - changed_ns > COMPLETE_AFTER_S * 1e9
                self._waiting = self._list()
                self._listed_change_ns = changed_ns if is_final else 0
        except OSError as error:
            self._report("folder", f"{self._root}: expected a folder of scans, found none ({error.strerror})")

    def _next_complete(self) -> Path | None:
        """Remove the first waiting file and return it if it is complete, otherwise return None."""
        if not self._waiting:
            return None
        path = self._waiting[0]
        try:
            file = path.stat()
        except OSError:  # it was removed or renamed
            self._waiting.pop(0)
            return None
        is_old = time.time() - file.st_mtime > COMPLETE_AFTER_S
        same_size = file.st_size > 0 and file.st_size == self._sizes.get(path)
        if is_old or same_size:
            self._sizes.pop(path, None)
            return self._waiting.pop(0)
        self._sizes[path] = file.st_size
        return None

    def _read_frame(self, path: Path, received: float) -> Iterator[LiveFrame | None]:
        """Yield None while the scan's pose is missing, at most for `MAX_POSE_WAIT_S`, then the scan. A scan that cannot
        be read is reported instead."""
        try:
            if self._bin_layout is None and self._options.format == "auto" and format_by_name(path) is None:
                self._bin_layout = detect_format_unless_kitti([path]) or "kitti"
            scan = scan_of_file(path, format=self._options.format, records=self._bin_layout or "kitti")
            stamp, written = _time_in_name(path), path.stat().st_mtime
        except Exception as error:  # whatever a file holds, the source lives on
            return self._report("scan", f"a scan is left out: {in_short(error, most=300)}")
        pose, is_late = None, False
        row = len(self._taken) - 1  # of the scan, and of its line in a file of poses without times
        while self._poses is not None and pose is None and not is_late:
            is_late = max(time.time() - written, time.monotonic() - received) >= MAX_POSE_WAIT_S
            pose = self._pose_or_none(self._poses, row, stamp, is_late=is_late)
            if pose is None and not is_late:
                time.sleep(POLL_S)
                yield None
        scan = dataclasses.replace(scan, name=_scan_name(path))
        yield LiveFrame(scan, time=written if stamp is None else stamp, odometry=pose, received=received)

    def _pose_or_none(
        self, poses: "GrowingPoses", row: int, stamp: float | None, *, is_late: bool
    ) -> Float[np.ndarray, "4 4"] | None:
        """Pose of a scan, or None if the file does not have it yet. An invalid line is reported."""
        try:
            poses.read_appended()
        except (ValueError, OSError) as error:  # of any line
            self._report("poses", in_short(error, most=300))
        return poses.of(row, stamp, is_late=is_late)


def _scan_name(path: Path) -> str:
    return str(path.resolve())


def _time_in_name(path: Path) -> float | None:
    """Time in seconds that the name of a file states, such as 1690000000.25.pcd, or None."""
    try:
        seconds = float(path.name[: -len(path.suffix)])
    except ValueError:
        return None
    return seconds if "." in path.stem and seconds > EPOCH else None


def _check_not_removed(root: Path, missing: Collection[str], poses: "GrowingPoses") -> None:
    """Raise ValueError if scans of the folder were removed, because later scans would then get the poses of other
    lines. `missing` has the names of the map that no file has."""
    folder = root.resolve()
    paths = sorted(path for path in map(Path, scan_names(missing)) if path.parent == folder)  # not those of a bag
    if by_line := [path.name for path in paths if not poses.has_time(_time_in_name(path))]:
        raise ValueError(
            f"{root}: expected all scans of the map, because the poses have a line for each, found {len(by_line)} "
            f"removed ({in_short(', '.join(by_line))}); use another folder for new scans and poses, or poses as tum "
            "and names with times (1690000000.25.pcd)"
        )


class GrowingPoses:
    """Poses of a file to which another program appends lines. The file need not exist yet."""

    def __init__(self, path: Path, format: PoseFormat, time_unit: TimeUnit):
        """Begin with nothing read. Raises ValueError for csv, which has no rotations."""
        if format == "csv":
            raise ValueError(f"{path}: expected poses as tum, kitti or lidar, found csv")
        self._path, self._format, self._unit = path, format, PER_SECOND[time_unit]
        self._begin()

    def _begin(self) -> None:
        """Begin with nothing read."""
        self._bytes_read = self._lines_read = 0
        self._dropped = 0  # number of poses before the first one below
        self._times: list[float] = []  # time of each pose, in seconds, in order. 0 in files without times.
        self._poses: list[np.ndarray | None] = []  # pose (4, 4) of each line. None for an invalid line.

    def read_appended(self) -> None:
        """Read the whole lines that were added since the last call. Raises ValueError for the first invalid line, after
        reading all. The scan of an invalid line has no pose. A file that begins anew is read from its beginning."""
        if not self._path.is_file():
            return
        first_error = None
        with self._path.open("rb") as file:
            if file.seek(0, os.SEEK_END) < self._bytes_read:
                self._begin()
                first_error = ValueError(f"{self._path}: expected a file that grows, found one that begins anew")
            file.seek(self._bytes_read)
            appended = file.read()
        whole_lines = appended[: appended.rfind(b"\n") + 1]
        self._bytes_read += len(whole_lines)
        for line in whole_lines.decode(errors="replace").splitlines():
            self._lines_read += 1
            try:
                if line.strip() and not line.startswith("#"):
                    self._add(line.split(), f"{self._path}, line {self._lines_read}")
            except ValueError as error:
                first_error = first_error or error
        if first_error is not None:
            raise first_error

    def of(self, row: int, time: float | None, *, is_late: bool = False) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of a scan, or None if the file does not have it yet. Scans and files with times are matched
        by `time`, in seconds, with interpolation. A pose at or after it is awaited, unless the scan `is_late`. Others
        are matched by `row`, the number of the scan. Poses long before that of the scan are dropped."""
        if not self.has_time(time):
            row = self._drop_before(row - self._dropped)
            return self._poses[row] if 0 <= row < len(self._poses) else None
        first_later = self._drop_before(bisect.bisect_left(self._times, time))
        near_lines = range(max(first_later - NEAR_POSES, 0), min(first_later + NEAR_POSES, len(self._poses)))
        valid = [(self._times[i], pose) for i in near_lines if (pose := self._poses[i]) is not None]
        needed = time - (BEYOND_S if is_late else SAME_S)
        if len(valid) < 2 or valid[-1][0] < needed:  # the file does not reach the time yet
            return None
        stamps, poses = zip(*valid, strict=True)
        return pose_at(np.array(stamps), np.stack(poses), time)

    def has_time(self, time: float | None) -> TypeGuard[float]:
        """Return whether a scan with this time, or without one, is matched by its time."""
        return time is not None and self._format in ("auto", "tum")

    def _drop_before(self, index: int) -> int:
        """Drop the poses more than `KEPT_POSES` before an index. Returns the index among the others."""
        dropped = min(max(index - KEPT_POSES, 0), len(self._poses))
        del self._times[:dropped], self._poses[:dropped]
        self._dropped += dropped
        return index - dropped

    def _add(self, words: list[str], where: str) -> None:
        """Append the pose and the time of a line. An invalid line gets no pose, and ValueError is raised."""
        if self._format == "auto" and len(words) == 12:
            raise ValueError(
                f"{where}: expected the axes of 12 numbers a line, found none; pass --pose-format kitti or lidar"
            )
        self._times.append(self._times[-1] if self._times else 0.0)
        self._poses.append(None)  # also if the line is invalid: the next line is that of the next scan
        if self._format in ("auto", "tum"):
            numbers = parse_numbers(words, columns=8, where=where)
            pose = quaternion_poses(where, numbers[None, 1:4], numbers[None, 4:])[0]
            self._times[-1] = float(numbers[0] / self._unit)
        else:
            numbers = parse_numbers(words, columns=12, where=where)
            pose = matrix_poses(where, numbers[None], camera=self._format == "kitti")[0]
        self._poses[-1] = pose


def open_source(where: str, options: LiveOptions, report: Report, map_names: Collection[str]) -> FolderSource:
    """Open the folder `where`. Raises FileNotFoundError if it does not exist."""
    root = Path(where)
    if not where or not root.is_dir():
        raise FileNotFoundError(f"folder:{where}: expected a folder, into which scans are written, found none")
    return FolderSource(root, options, report, map_names)
