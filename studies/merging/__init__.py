"""Merges of maps in soak runs: outcomes, and tables of kept runs."""
