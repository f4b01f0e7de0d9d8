"""Readers of single files: scans, poses and label images."""
