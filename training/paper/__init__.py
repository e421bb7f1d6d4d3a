"""Figures of the paper, reproduced in simulation."""
