"""Heads for cameras: images in, boxes in the image or masks of it out."""
