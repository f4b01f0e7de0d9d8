"""Loops: from places that look alike to verified poses between scans, as a stream, as files, and in a saved map."""
