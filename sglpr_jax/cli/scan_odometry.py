"""`--odometry auto`: commands compute the odometry from the scans before they use it."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sglpr_jax.cli.recording import report_bad_scan, resolved_scale
from sglpr_jax.cli.runtime import progress_bar, stop_on_signal
from sglpr_jax.odometry.config import OdometryConfig

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from sglpr_jax.data.choices import Scale
    from sglpr_jax.data.recording import Recording

AUTO = "auto"
"""Value of a flag for poses that are computed from the scans."""
ENDING = ".odometry.npz"
"""End of the name of a checkpoint file."""
T = TypeVar("T")


def check_auto() -> None:
    """Raise ImportError if the extra `odometry` is not installed."""
    from sglpr_jax.odometry.kiss_icp import check_installed  # slow import, not needed for --help

    check_installed()


def open_with_scan_odometry(command: T) -> "tuple[T, list[Recording], list[Float[np.ndarray, 'n 4 4']]]":
    """Open the recordings of a `LoopsCommand` and compute their odometry.

    If the command is interrupted before all odometry is complete, it ends.

    Returns:
      The command with the settings that are in effect, the recordings, deskewed and with submaps, and their odometry.
    """
    given: Any = command
    opened = [given.source.open(path) for path in given.recordings]
    scale = resolved_scale(given.scale, *opened)
    odometry = [
        odometry_of(one, given.scan_odometry, scale=scale, kept_in=_kept_in(given.out, number), skip_bad=given.skip_bad)
        for number, one in enumerate(opened)
    ]
    submap = with_deskew(given.submap, opened)
    recordings = [submap.prepared(one, poses) for one, poses in zip(opened, odometry, strict=True)]
    effective = given.scan_odometry.effective
    return dataclasses.replace(given, scale=scale, submap=submap, scan_odometry=effective), recordings, odometry


def odometry_of(
    recording: "Recording", config: OdometryConfig, *, scale: "Scale", kept_in: Path, skip_bad: bool
) -> "Float[np.ndarray, 'n 4 4']":
    """Odometry of a recording, with progress on stderr. If it is interrupted, the command ends.

    Arguments:
      recording: The scans.
      config: Settings of the odometry.
      scale: Factor for all lengths.
      kept_in: Checkpoint file.
      skip_bad: Whether unreadable scans are reported and skipped.
    """
    from sglpr_jax.odometry.kiss_icp import about, scan_odometry

    if not recording.has_images:
        print(about(recording, config, scale=scale), file=sys.stderr)
    with stop_on_signal() as stop, progress_bar(f"odometry {recording.name}", len(recording)) as show:
        poses = scan_odometry(
            recording,
            config=config,
            scale=scale,
            kept_in=kept_in,
            on_bad_scan=report_bad_scan if skip_bad else None,
            should_stop=stop,
            on_progress=show,
        )
    if len(poses) < len(recording):
        print(f"odometry of {len(poses)} of {len(recording)} scans; run the same command again to continue")
        sys.exit(stop.exit_status)
    return poses


def with_deskew(submap: T, recordings: "list[Recording]") -> T:
    """`SubmapOptions` that remove the motion within scans, if the points of all recordings have times."""
    from sglpr_jax.data.deskew import has_point_times

    chosen: Any = submap
    return dataclasses.replace(chosen, deskew=chosen.deskew or all(map(has_point_times, recordings)))


def remove_odometry(command: Any) -> None:
    """Delete the checkpoint files of a `LoopsCommand`."""
    for number in range(len(command.recordings)):
        _kept_in(command.out, number).unlink(missing_ok=True)


def _kept_in(out: Path, number: int) -> Path:
    return out / f"unfinished-{number}{ENDING}"
