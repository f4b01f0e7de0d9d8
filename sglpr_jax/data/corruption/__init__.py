"""Scans made worse on purpose, for the stress test."""
