"""Exploration policies that see only what a robot can know, and their comparison."""
