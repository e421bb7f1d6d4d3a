"""Alignment benchmarks on simulated and real pairs of maps."""
