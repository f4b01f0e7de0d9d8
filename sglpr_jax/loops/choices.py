"""What a user may choose about loops and maps, and what holds otherwise.

Here, because a command line names it in its help without importing the rest.
"""

from typing import Literal

OdometryFormat = Literal["auto", "kitti", "lidar", "tum", "g2o"]
"""kitti, lidar: 12 numbers a line, in KITTI's camera axes or z up; tum: time, position, quaternion; g2o: vertices."""
Degenerate = Literal["keep", "drop"]
"""Loops whose position is uncertain by more than 1 m along one direction, as between walls: kept or rejected."""
MIN_PROBABILITY = 0.99
"""Of a loop that is returned."""
SPACING_M = 1.0
"""Scans nearer than this to the last place of their own drive are left out of a map."""
CANDIDATES = 5
"""How many places of a map are looked at."""
DRIFT_PERCENT = 1.0
"""Position drift of odometry: one standard deviation, in percent of the travelled distance."""
DRIFT_DEG_PER_100M = 0.5
"""Heading drift of odometry: one standard deviation, in degrees per 100 m of travelled distance."""
