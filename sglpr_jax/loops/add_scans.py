"""Adds the scans of a recording to a loop search or a map. With a checkpoint directory, a killed run resumes."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import OnBadScan, scan_stream
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.unfinished import Unfinished, settings


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
