"""Figures of the paper, computed from simulation."""
