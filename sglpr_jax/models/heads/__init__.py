"""From feature maps to a descriptor, or to classes."""
