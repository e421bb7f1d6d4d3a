"""Families of random worlds."""
