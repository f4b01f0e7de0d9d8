"""Distances that define "the same place"."""

POSITIVE_M = 3.0
"""Maximum distance of two scans that show the same place, in metres."""
NEGATIVE_M = 20.0
"""Distance beyond which two scans show different places, in metres. Between the two limits a pair is neither."""
