"""Loop closures while the robot drives: scans from a source, loop edges to sinks, a map that survives a crash."""
