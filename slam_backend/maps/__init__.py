"""Alignment, verification and fusion of landmark maps."""
