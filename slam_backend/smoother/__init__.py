"""Rejuvenation: particles drawn anew from the posterior of whole paths; docs/smoothing.md has the equations (n)."""
