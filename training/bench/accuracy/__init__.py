"""Errors and consistency of the filter beside batch maximum likelihood."""
