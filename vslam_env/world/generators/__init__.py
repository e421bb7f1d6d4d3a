"""Generators of random worlds by family."""
