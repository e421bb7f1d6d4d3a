"""Benchmarks of the command line, a folder for each."""
