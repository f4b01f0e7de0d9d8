"""Methods that compute descriptors: the network, and methods without training."""
