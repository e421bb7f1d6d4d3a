"""Exploration episodes with given policies: runner, metrics, tables, figures and videos."""
