"""Stereo benchmark: speed and quality of the front end."""
