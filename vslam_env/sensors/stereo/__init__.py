"""Rendered stereo cameras: textures, images, ground truth and measurements of the front end."""
