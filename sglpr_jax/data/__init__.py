"""Reads datasets from disk: a `Recording` is a sequence of scans, and a `Record` is one scan with its labels."""
