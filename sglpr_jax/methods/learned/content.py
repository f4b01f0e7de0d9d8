"""Checks that a recording contains what a method needs."""

from sglpr_jax.data.recording import Recording
from sglpr_jax.methods.method import Takes


def require_content(name: str, takes: Takes, recording: Recording, *, every_label: bool = False) -> None:
    """Raise ValueError, in one line, if a recording lacks the points or labels of the method called `name`.

    Arguments:
      name: Name of the method.
      takes: Input of the method. Methods on images also accept scans.
      recording: Recording to check.
      every_label: Whether every scan must have labels. Otherwise one label file suffices.
    """
    if takes == "images":
        return
    if recording.has_images:
        raise ValueError(f"{name} needs points, found only images in sequence {recording.name}")
    if takes != "labelled points":
        return
    if not recording.has_labels:
        raise ValueError(f"{name} needs labels beside the scans, found none in sequence {recording.name}")
    missing = [name for name, labelled in zip(recording.ids, recording.labelled, strict=True) if not labelled]
    if every_label and missing:
        raise ValueError(
            f"{name} needs labels of every scan, found none for {len(missing)} scans of sequence {recording.name}, "
            f"the first is {missing[0]}"
        )
