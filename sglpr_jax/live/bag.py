"""Source of scans from a ROS bag, replayed at the times of its scans or as fast as possible."""

import dataclasses
import threading
import time
from collections.abc import Collection, Iterator
from pathlib import Path

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import in_short
from sglpr_jax.live.data_types import WAIT_S, LatestScan, LiveFrame, Report
from sglpr_jax.live.options import LiveOptions


class BagSource:
    """Scans of a bag at the times of their headers, `rate` times as fast. With `rate=0`, as fast as they are taken."""

    def __init__(
        self, root: Path, recording: Recording, options: LiveOptions, report: Report, map_names: Collection[str]
    ):
        """Begin after the last scan whose name is in `map_names`."""
        self._root, self._recording, self._rate, self._report = root.resolve(), recording, options.rate, report
        self._poses = None if options.odometry_topic is None else recording.world_from_lidar
        last_taken = max((row for row in range(len(recording)) if self._scan_name(row) in map_names), default=-1)
        self._rows = range(last_taken + 1, len(recording))
        self._latest: LatestScan[LiveFrame] = LatestScan()
        self._stopped, self._ended = threading.Event(), threading.Event()

    @property
    def dropped(self) -> int:
        return self._latest.dropped

    def frames(self) -> Iterator[LiveFrame | None]:
        """Yield the scans, and None while none arrives. Ends after the last one."""
        if not self._rate:
            for row in self._rows:
                yield self._read_frame(row)
            return
        thread = threading.Thread(target=self._replay, daemon=True)
        thread.start()
        while (frame := self._latest.take(WAIT_S)) is not None or not self._ended.is_set():
            yield frame
        yield self._latest.take(0.0)  # one may have come between the two conditions

    def close(self) -> None:
        self._stopped.set()

    def _replay(self) -> None:
        """Put each scan into `_latest` at its time. Runs in its own thread."""
        times, begin = self._recording.times, time.monotonic()
        try:
            for row in self._rows:
                frame = self._read_frame(row)
                due_s = 0.0 if times is None else (times[row] - times[self._rows[0]]) / self._rate
                if self._stopped.wait(max(0.0, begin + due_s - time.monotonic())):
                    return
                if frame is not None:
                    self._latest.put(frame._replace(received=time.monotonic()))
        finally:
            self._ended.set()

    def _read_frame(self, row: int) -> LiveFrame | None:
        """Read a scan. If it cannot be read, report the error and return None."""
        try:
            scan = self._recording.scan(row, labels=False)
        except Exception as error:  # whatever a scan holds, the replay goes on
            return self._report("scan", f"a scan is left out: {in_short(error, most=300)}")
        pose = None if self._poses is None else self._poses[row]
        stamp = 0.0 if self._recording.times is None else float(self._recording.times[row])
        scan = dataclasses.replace(scan, name=self._scan_name(row))
        return LiveFrame(scan, time=stamp, odometry=pose, received=time.monotonic(), is_recorded=True)

    def _scan_name(self, row: int) -> str:
        return f"{self._root}, scan {self._recording.ids[row]}"


def open_source(where: str, options: LiveOptions, report: Report, map_names: Collection[str]) -> BagSource:
    """Open the bag `where`.

    Raises:
      FileNotFoundError: If there is no bag, or if it has several topics and none of them is `options.topic`.
      ValueError: If the bag is broken, or `options.odometry_topic` has no poses with rotations.
      ImportError: If the extra `ros` is not installed.
    """
    root = Path(where)
    names = recording_names(root)
    name = None if options.topic is None else options.topic.strip("/").replace("/", "_")
    if len(names) == 1 and name not in names:  # a single recording is not named by its topic
        name = None
    pose_topic = options.odometry_topic or ""  # "" reads no poses, so that scans without a pose are kept
    recording = open_recording(
        root, name, pose_topic=pose_topic, sensor_height=options.sensor_height, gravity="recording"
    )
    if options.odometry_topic is not None and recording.world_from_lidar is None:
        raise ValueError(f"{root}: expected poses with rotations on {options.odometry_topic}, found none")
    return BagSource(root, recording, options, report, map_names)
