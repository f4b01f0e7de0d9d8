"""Labels that a model made (pseudo-labels), beside images that have none of their own.

06/000000.png   the label image (`label_images.py`) of image 000000 of recording 06; `bin/segment` writes such files
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from sglpr_jax.data.recording import Recording


def with_pseudo_labels(recordings: Sequence[Recording], folder: Path) -> list[Recording]:
    """Return the recordings, those of images without any labels with the label images of `folder`.

    An image without a label image stays unlabelled. Raises FileNotFoundError where `folder` has none for any recording.
    """
    labelled = [_labelled(recording, folder / recording.name) for recording in recordings]
    if not any(new is not old for new, old in zip(labelled, recordings, strict=True)):
        wanted = [each.name for each in recordings if each.has_images and not each.has_labels]
        raise FileNotFoundError(
            f"{folder}: expected label images NN/<id>.png of recordings of images without labels of their own "
            f"({', '.join(wanted) or 'of which there are none'}), found none"
        )
    return labelled


def _labelled(recording: Recording, folder: Path) -> Recording:
    if not recording.has_images or recording.has_labels:
        return recording
    there = {path.stem: path for path in folder.glob("*.png")}
    label_paths = tuple(there.get(image) for image in recording.ids)
    return dataclasses.replace(recording, label_paths=label_paths) if any(label_paths) else recording
