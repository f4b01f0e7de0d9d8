"""Single files: scans, poses, label images."""
