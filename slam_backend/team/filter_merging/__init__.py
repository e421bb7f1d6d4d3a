"""Merging of two particle filters: pairing of particles and fusion of landmarks."""
