"""Exploration benchmark: comparison of policies over worlds."""
