"""Measurement model, and the pose given measurements and their landmarks."""
