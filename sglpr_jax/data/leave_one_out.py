"""Splits the recordings of a dataset for leave-one-out training: one is tested, the others are trained on."""

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
    """Open the training recordings and the test recording of a dataset.

    Arguments:
      root: Folder of the dataset.
      test: Name of the test recording.
      train: Names of the training recordings. If empty, all recordings except `test` are used.
      pose_source: See `open_recording`.
      format: See `open_recording`.
      sensor_height: See `open_recording`.

    Returns:
      The training recordings and the test recording.

    Raises:
      FileNotFoundError: If a recording does not exist.
      ValueError: If `test` is among the training recordings, no training recording remains, or a recording has no
        positions.
    """
    options = {"pose_source": pose_source, "format": format, "sensor_height": sensor_height}
    tested = open_recording(root, test, **options)
    names = tuple(train) or tuple(name for name in recording_names(root) if name != test)
    if not names or test in names:
        raise ValueError(
            f"{root}: expected training recordings other than {test!r}, found {', '.join(names) or 'none'}"
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
    """Open every recording of a dataset. All recordings must have positions.

    The options and errors are those of `leave_one_out`.
    """
    options = {"pose_source": pose_source, "format": format, "sensor_height": sensor_height}
    recordings = [open_recording(root, name, **options) for name in recording_names(root)]
    _require_positions(root, recordings)
    return recordings


def _require_positions(root: Path, recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        if recording.positions is None:
            raise ValueError(f"{root}: sequence {recording.name} has no poses; training and testing need them")
