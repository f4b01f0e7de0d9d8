"""What a drive is where a user chooses nothing else.

Here, because a command line names it in its help without importing the rest.
"""

SCANS = 300
"""Of each recording."""
RATE_HZ = 4.0
"""Scans per second, so that at a car's speed they lie some 2 m apart; KITTI's car took 10."""
