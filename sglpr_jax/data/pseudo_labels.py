"""Adds labels that a model predicted (pseudo-labels) to images without labels.

06/000000.png   label image (`label_images.py`) of image 000000 of recording 06, as written by `bin/segment`
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from sglpr_jax.data.recording import Recording
from sglpr_jax.files import file_name


def with_pseudo_labels(recordings: Sequence[Recording], folder: Path) -> list[Recording]:
    """Return the recordings, with label images from `folder` added to recordings of images without labels.

    An image without a label image stays unlabelled.

    Raises:
      FileNotFoundError: If `folder` has no label image for any recording.
    """
    labelled = [_labelled(recording, folder / file_name(recording.name)) for recording in recordings]
    if not any(new is not old for new, old in zip(labelled, recordings, strict=True)):
        wanted = [each.name for each in recordings if each.has_images and not each.has_labels]
        raise FileNotFoundError(
            f"{folder}: expected label images NN/<id>.png for the image recordings without labels "
            f"({', '.join(wanted) or 'the data has no image recording without labels'}), found none"
        )
    return labelled


def _labelled(recording: Recording, folder: Path) -> Recording:
    if not recording.has_images or recording.has_labels:
        return recording
    there = {path.stem: path for path in folder.glob("*.png")}
    label_paths = tuple(there.get(file_name(image)) for image in recording.ids)
    return dataclasses.replace(recording, label_paths=label_paths) if any(label_paths) else recording
