"""Recordings for training: leave-one-out splits of a dataset, and labels that a model predicted (pseudo-labels)."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import file_name


def leave_one_out(
    roots: Sequence[Path], test: str, *, train: Sequence[str] = (), **options: Any
) -> tuple[list[Recording], Recording]:
    """Open the training recordings and the test recording of datasets. All must have positions.

    Arguments:
      roots: Folders of the datasets, or bags. The names of their recordings must differ.
      test: Name of the test recording.
      train: Names of the training recordings, by default all except `test`.
      options: Options of `open_recording`.

    Raises FileNotFoundError if a named recording is missing, and ValueError if two recordings have the same name,
    `test` is among the training recordings or no training recording remains.
    """
    root_of = dict[str, Path]()
    for root in roots:
        for name in recording_names(root):
            if name in root_of:
                raise ValueError(
                    f"{root}: expected recordings with new names, found {name!r}, as in {root_of[name]}; rename one"
                )
            root_of[name] = root
    names = tuple(train) or tuple(name for name in root_of if name != test)
    where = ", ".join(map(str, roots))
    if missing := [name for name in (test, *names) if name not in root_of]:
        raise FileNotFoundError(f"{where}: expected sequence {missing[0]!r}, found {', '.join(root_of)}")
    if not names or test in names:
        raise ValueError(
            f"{where}: expected training recordings other than {test!r}, found {', '.join(names) or 'none'}"
        )
    test_recording, *recordings = (_with_positions(root_of[name], name, **options) for name in (test, *names))
    return recordings, test_recording


def all_recordings(root: Path, **options: Any) -> list[Recording]:
    """Open every recording of a dataset with the options of `open_recording`. All must have positions."""
    return [_with_positions(root, name, **options) for name in recording_names(root)]


def _with_positions(root: Path, name: str, **options: Any) -> Recording:
    """Open a recording. Raises ValueError if it has no positions."""
    recording = open_recording(root, name, **options)
    if recording.positions is None:
        raise ValueError(
            f"{root}: sequence {name} has no poses, which training and testing need; use a folder in which all "
            "sequences have poses, or for --data of bin/train choose those with --seq and --train-seq"
        )
    return recording


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
