"""Input of a training step: tuples of places, and batches of tuples."""
