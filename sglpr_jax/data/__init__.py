"""Reads datasets from disk: a `Recording` is a sequence of scans, and a `Record` is one scan with its labels."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sglpr_jax.data.formats.scan_files import read_scan
    from sglpr_jax.data.readers import open_recording, recording_names
    from sglpr_jax.data.record import Record
    from sglpr_jax.data.recording import Recording

_HOME_OF = {
    "Record": "record",
    "Recording": "recording",
    "open_recording": "readers",
    "read_scan": "formats.scan_files",
    "recording_names": "readers",
}
"""Module that defines each public name. The module is imported when the name is first used."""


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    return globals()[name]


__all__ = ["Record", "Recording", "open_recording", "read_scan", "recording_names"]
