"""Landmark maps: aligned, verified, fused."""
