"""Rendered stereo cameras: textures, images, their ground truth, and the front end that reads them."""
