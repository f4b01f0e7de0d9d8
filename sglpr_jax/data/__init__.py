"""Data: whatever lies on disk becomes a `Recording`, and each of its scans, read once, a `Record`."""

from sglpr_jax.data.formats.scan_files import read_scan
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording

__all__ = ["Record", "Recording", "open_recording", "read_scan", "recording_names"]
