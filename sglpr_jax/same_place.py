"""Distances within which two scans show the same place, and the minimum time between them for a revisit."""

POSITIVE_M = 3.0
"""Maximum distance of two scans that show the same place, in metres."""
NEGATIVE_M = 20.0
"""Distance beyond which two scans show different places, in metres. Between the two limits a pair is neither."""
EXCLUDED_S = 30.0
"""Minimum time between a query and its match, in seconds. Closer frames are neighbours, not revisits."""
EXCLUDED_FRAMES = 290
"""Replaces EXCLUDED_S for sequences without times: 30 s at KITTI's 9.6 scans per second."""
SAME_PASS_FRAMES = 50
"""Minimum length of one pass, in frames, in training (`TupleConfig.revisit_gap`). It is smaller than EXCLUDED_FRAMES,
because a vehicle that returns after 5 s also gives training pairs."""
