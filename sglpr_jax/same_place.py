"""What "the same place" means in metres."""

POSITIVE_M = 3.0
"""Two scans no farther apart than this show the same place."""
NEGATIVE_M = 20.0
"""Two scans farther apart than this show different places; in between nothing is claimed."""
