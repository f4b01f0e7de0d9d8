"""Default settings of a simulated drive.

This module imports nothing, so a command line can show the defaults in its help without loading the simulator.
"""

SCANS = 300
"""Number of scans of each recording."""
RATE_HZ = 4.0
"""Scans per second. At a car's speed, the scans are about 2 m apart. KITTI has 10 scans per second."""
