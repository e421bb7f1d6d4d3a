"""Rejuvenation: particles drawn anew from the posterior of whole paths, see docs/smoothing.md."""
