"""Beliefs measured against the truth: coverage, map errors, metrics of the team."""
