"""Command lines: each module here is one command, thin over the library."""

import gc

gc.set_threshold(100_000)  # imports and tracing make objects that stay: looking for garbage took an eighth of a start
