"""Packs recordings into a few large files, which are faster to read."""
