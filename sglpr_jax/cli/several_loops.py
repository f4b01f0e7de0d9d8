"""bin/loops with several recordings: loops within and between them, and the transforms between their frames."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.recording import open_with_poses, report_bad_scan, resolved_scale
from sglpr_jax.cli.runtime import progress_bar, stop_on_signal
from sglpr_jax.cli.scan_odometry import AUTO, open_with_scan_odometry, remove_odometry

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from sglpr_jax.data.recording import Recording
    from sglpr_jax.loops.config import DetectorConfig
    from sglpr_jax.loops.search_between import FoundRecordings


def search_several(command: Any, config: "DetectorConfig", *, unfinished: Path) -> int:
    """Search several recordings and write the results. Returns the exit status. `command` is a `LoopsCommand`."""
    from sglpr_jax.evaluation.loops_page import PAGE, loops_page
    from sglpr_jax.loops.checkpoint import remove
    from sglpr_jax.loops.search_between import find_loops_between
    from sglpr_jax.models.weights_file import load
    from sglpr_jax.pose_graph.folder import write_several
    from sglpr_jax.pose_graph.optimize import optimize_recordings

    params = load(command.weights)
    if command.odometry == AUTO:
        command, recordings, odometry = open_with_scan_odometry(command)
    else:
        recordings, odometry = _opened(command)
    scale = resolved_scale(command.scale, *recordings)
    steps = sum((1 + number) * len(recording) for number, recording in enumerate(recordings))
    with stop_on_signal() as stop, progress_bar(f"loops of {len(recordings)} recordings", steps) as show:
        found = find_loops_between(
            recordings,
            params,
            odometry=odometry,
            config=config,
            registered=None if command.register else False,
            scale=scale,
            on_bad_scan=report_bad_scan if command.skip_bad else None,
            kept_in=unfinished,
            should_stop=stop,
            on_progress=show,
        )
    if command.degenerate == "drop":
        found = found.without_degenerate()
    corrected = optimize_recordings(found) if command.optimize else None
    page = {PAGE: loops_page(found, optimized=corrected)}
    paths = write_several(found, command.out, optimized=corrected, texts=page)
    paths.append(record_command(dataclasses.replace(command, scale=scale), command.out))
    _report(found)
    for one in () if corrected is None else corrected.corrections:
        print(one)
    print(f"{command.out}: {', '.join(path.name for path in paths)}")
    if not found.whole:
        print("run the same command again to continue", file=sys.stderr)
        return stop.exit_status
    for number in range(len(recordings)):
        remove(unfinished / f"{number}")
    remove(unfinished)
    remove_odometry(command)
    return 0


def _opened(command: Any) -> "tuple[list[Recording], list[Float[np.ndarray, 'n 4 4']] | None]":
    """Open the recordings, with their odometry if there is one."""
    paths, files = command.recordings, command.odometry_files
    if not files:
        return [command.submap.prepared(command.source.open(path), None) for path in paths], None
    opened = [
        open_with_poses(command.source, path, file, format=command.odometry_format)
        for path, file in zip(paths, files, strict=True)
    ]
    return [command.submap.prepared(*one) for one in opened], [poses for _, poses in opened]


def _report(found: "FoundRecordings") -> None:
    """Print the results, and why a recording has no loops of its own."""
    from sglpr_jax.loops.search import why_none

    print(found)
    for one in found.recordings:
        for line in why_none(one):
            print(f"{one.recording.name}: {line}")
