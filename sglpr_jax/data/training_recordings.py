"""Recordings for training: leave-one-out splits of a dataset, and labels that a model predicted (pseudo-labels)."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import file_name


def leave_one_out(
    root: Path, test: str, *, train: Sequence[str] = (), **options: Any
) -> tuple[list[Recording], Recording]:
    """Open the training recordings and the test recording of a dataset. All must have positions.

    Arguments:
      root: Folder of the dataset.
      test: Name of the test recording.
      train: Names of the training recordings, by default all except `test`.
      options: Options of `open_recording`.

    Raises FileNotFoundError, or ValueError if `test` is among the training recordings or no training recording remains.
    """
    test_recording = open_recording(root, test, **options)
    names = tuple(train) or tuple(name for name in recording_names(root) if name != test)
    if not names or test in names:
        raise ValueError(
            f"{root}: expected training recordings other than {test!r}, found {', '.join(names) or 'none'}"
        )
    recordings = [open_recording(root, name, **options) for name in names]
    _check_positions(root, [*recordings, test_recording])
    return recordings, test_recording


def all_recordings(root: Path, **options: Any) -> list[Recording]:
    """Open every recording of a dataset with the options of `open_recording`. All must have positions."""
    recordings = [open_recording(root, name, **options) for name in recording_names(root)]
    _check_positions(root, recordings)
    return recordings


def _check_positions(root: Path, recordings: Sequence[Recording]) -> None:
    """Raise ValueError if a recording has no positions."""
    for recording in recordings:
        if recording.positions is None:
            raise ValueError(f"{root}: sequence {recording.name} has no poses; training and testing need them")


def with_pseudo_labels(recordings: Sequence[Recording], folder: Path) -> list[Recording]:
    """Return the recordings, with label images from `folder` added to recordings of images without labels.

    The folder has a label image `06/000000.png` for image 000000 of recording 06, as written by `bin/segment`. Raises
    FileNotFoundError if it has no label image for any of them.
    """
    names = []  # of the recordings of images without labels
    results, has_added = [], False
    for recording in recordings:
        label_paths: tuple[Path | None, ...] = ()
        if recording.has_images and not recording.has_labels:
            names.append(recording.name)
            files = {path.stem: path for path in (folder / file_name(recording.name)).glob("*.png")}
            label_paths = tuple(files.get(file_name(image_id)) for image_id in recording.ids)
        if any(label_paths):
            recording, has_added = dataclasses.replace(recording, label_paths=label_paths), True
        results.append(recording)
    if not has_added:
        raise FileNotFoundError(
            f"{folder}: expected label images NN/<id>.png for the image recordings without labels "
            f"({', '.join(names) or 'the data has no image recording without labels'}), found none"
        )
    return results
