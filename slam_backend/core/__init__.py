"""Foundations of the backend: validation, kernel compilation, files and states."""
