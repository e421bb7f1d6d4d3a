"""Accuracy benchmark: errors and consistency of filters, against batch maximum likelihood."""
