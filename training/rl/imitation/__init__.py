"""Imitation of a planner: labels on disk, their collection, and cloning with rounds in which the pupil drives."""
