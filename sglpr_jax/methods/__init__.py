"""What a descriptor can come from: the network, and methods without training."""
