"""Data: whatever lies on disk becomes a `Recording`, and each of its scans, read once, a `Record`."""

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
"""Where each name is defined, to be imported when it is first asked for."""


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    return globals()[name]


__all__ = ["Record", "Recording", "open_recording", "read_scan", "recording_names"]
