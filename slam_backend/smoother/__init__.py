"""Rejuvenation of particles from the posterior of whole paths; equations (n) in `docs/reference/smoother.md`."""
