"""Exploration policies compared over worlds."""
