"""Compiled inner loops of filter merging."""
