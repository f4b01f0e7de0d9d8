"""Recordings packed into a few large files, to be read faster."""
