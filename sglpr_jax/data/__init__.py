"""Reads datasets from disk: a `Recording` is a sequence of scans, and a `Scan` is one scan with its labels."""
