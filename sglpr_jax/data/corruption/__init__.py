"""Artificially degraded scans for the stress test."""
