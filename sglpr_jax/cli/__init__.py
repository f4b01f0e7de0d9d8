"""Command lines: each module here is one command, thin over the library."""
