"""Labels that a model made (pseudo-labels), beside images that have none of their own.

06/000000.png   the label map (`label_maps.py`) of image 000000 of drive 06; `bin/segment` writes such files
"""

import dataclasses
from collections.abc import Sequence as Many
from pathlib import Path

from sglpr_jax.data.sequence import Drive, ImageSequence


def with_pseudo_labels(drives: Many[Drive], folder: Path) -> list[Drive]:
    """Return the drives, those of images without any labels with the label maps of `folder`.

    An image without a map stays unlabelled. Raises FileNotFoundError where `folder` has no map for any drive.
    """
    labelled = [_labelled(drive, folder / drive.name) for drive in drives]
    if not any(new is not old for new, old in zip(labelled, drives, strict=True)):
        wanted = [d.name for d in drives if isinstance(d, ImageSequence) and not d.has_labels]
        raise FileNotFoundError(
            f"{folder}: expected label maps NN/<id>.png of drives of images without labels of their own "
            f"({', '.join(wanted) or 'of which there are none'}), found none"
        )
    return labelled


def _labelled(drive: Drive, folder: Path) -> Drive:
    if not isinstance(drive, ImageSequence) or drive.has_labels:
        return drive
    there = {path.stem: path for path in folder.glob("*.png")}
    label_paths = tuple(there.get(image) for image in drive.ids)
    return dataclasses.replace(drive, label_paths=label_paths) if any(label_paths) else drive
