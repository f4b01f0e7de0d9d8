"""Training of the networks of other publications (`methods/learned/`): one loop for all of them."""
