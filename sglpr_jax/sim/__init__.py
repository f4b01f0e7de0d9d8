"""Simulator of LiDAR recordings with labels and true poses. This module imports nothing slow."""

SCANS = 300  # default number of scans of a recording
RATE_HZ = 4.0
"""Default scans per second. At a car's speed, the scans are about 2 m apart. KITTI has 10 scans per second."""
