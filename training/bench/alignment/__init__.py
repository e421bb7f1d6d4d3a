"""Alignment of maps of real robots."""
