"""Merging of two particle filters: landmarks paired, particles paired, logs and graphs joined."""
