"""Heads: networks from feature maps to a descriptor or to classes."""
