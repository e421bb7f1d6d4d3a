"""Merges of maps in soak runs: outcomes, claims of relative poses, and tables of kept runs."""
