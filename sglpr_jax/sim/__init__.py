"""Simulator of drives through towns: LiDAR scans with poses and semantic labels, without any dataset licence."""
