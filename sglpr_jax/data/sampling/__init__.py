"""What a training step reads: tuples of places, and the batches made of them."""
