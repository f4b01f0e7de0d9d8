"""Which recordings of a dataset are trained on and which one is tested: all but one, and that one."""

from collections.abc import Sequence
from pathlib import Path

from sglpr_jax.data.choices import PoseChoice, ScanFormat, SensorHeight
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording


def leave_one_out(
    root: Path,
    test: str,
    *,
    train: Sequence[str] = (),
    pose_source: PoseChoice = "auto",
    format: ScanFormat = "auto",
    sensor_height: SensorHeight = "auto",
) -> tuple[list[Recording], Recording]:
    """Return the recordings to train on (all but `test`, or those named) and the one to test on.

    Of the other options see `open_recording`. Raises FileNotFoundError for a recording that does not exist, ValueError
    where the test recording would be trained on, nothing is left to train on, or a recording has no positions.
    """
    options = {"pose_source": pose_source, "format": format, "sensor_height": sensor_height}
    tested = open_recording(root, test, **options)
    names = tuple(train) or tuple(name for name in recording_names(root) if name != test)
    if not names or test in names:
        raise ValueError(
            f"{root}: expected recordings to train on other than {test!r}, found {', '.join(names) or 'none'}"
        )
    recordings = [open_recording(root, name, **options) for name in names]
    _require_positions(root, [*recordings, tested])
    return recordings, tested


def all_recordings(
    root: Path,
    *,
    pose_source: PoseChoice = "auto",
    format: ScanFormat = "auto",
    sensor_height: SensorHeight = "auto",
) -> list[Recording]:
    """Return every recording of a dataset; all must have positions. Options and errors as of `leave_one_out`."""
    options = {"pose_source": pose_source, "format": format, "sensor_height": sensor_height}
    recordings = [open_recording(root, name, **options) for name in recording_names(root)]
    _require_positions(root, recordings)
    return recordings


def _require_positions(root: Path, recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        if recording.positions is None:
            raise ValueError(f"{root}: sequence {recording.name} has no poses; training and testing need them")
