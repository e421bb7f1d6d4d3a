"""Rejuvenation: particles sampled from the posterior of whole paths.

`docs/explanation/smoothing.md` has the equations (n).
"""
