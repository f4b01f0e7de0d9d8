"""From the image to feature maps."""
