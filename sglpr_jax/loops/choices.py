"""Options and defaults of loops and maps.

They are a separate module, so that `--help` does not import the rest.
"""

from typing import Annotated, Literal

from sglpr_jax.fields import Bounds

OdometryFormat = Literal["auto", "kitti", "lidar", "tum", "g2o"]
"""Format of odometry. "kitti" and "lidar" have 12 numbers a line, in KITTI's camera axes or with z up. "tum" has time,
position and quaternion. "g2o" has the vertices of a graph."""
Degenerate = Literal["keep", "drop"]
"""Whether degenerate loops are kept or rejected. The position of a degenerate loop is uncertain by more than 1 m in one
horizontal direction, for example between plain walls."""
MIN_PROBABILITY = 0.99
"""Minimum probability of a returned loop."""
SPACING_M = 1.0
"""Minimum distance of consecutive places of a drive in a map, in metres."""
PlaceCount = Annotated[int, Bounds(1, 1000)]
PlaceCountOrNone = Annotated[int, Bounds(0, 1000)]
"""Number of places whose images are compared with a query. Each takes milliseconds."""
CANDIDATES = 5
"""Number of nearest places of a map that a query is compared with."""
DRIFT_PERCENT = 1.0
"""Position drift of odometry: one standard deviation, in percent of the travelled distance."""
DRIFT_DEG_PER_100M = 0.5
"""Heading drift of odometry: one standard deviation, in degrees per 100 m of travelled distance."""
DRIFT_HEIGHT_PERCENT = 0.3
"""Height drift of odometry: one standard deviation, in percent of the travelled distance."""
