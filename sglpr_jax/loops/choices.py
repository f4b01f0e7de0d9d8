"""What a user may choose about loops and maps, and what holds otherwise.

Here, because a command line names it in its help without importing the rest.
"""

from typing import Literal

OdometryFormat = Literal["auto", "kitti", "lidar", "tum", "g2o"]
"""kitti, lidar: 12 numbers a line, in KITTI's camera axes or z up; tum: time, position, quaternion; g2o: vertices."""
MIN_PROBABILITY = 0.99
"""Of a loop that is returned."""
SPACING_M = 1.0
"""Scans nearer than this to the last place of their own drive are left out of a map."""
CANDIDATES = 5
"""How many places of a map are looked at."""
