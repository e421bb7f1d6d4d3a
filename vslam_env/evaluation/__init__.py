"""Evaluation of beliefs against ground truth: coverage, map errors and team metrics."""
