"""Ideal estimates from the readings of a run: each pose online, and the readings of episodes with their truth."""
