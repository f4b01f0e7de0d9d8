"""Backbones: networks from the image to feature maps."""
