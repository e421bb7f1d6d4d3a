"""Simulated stereo runs through an office, their scores, and maximum likelihood estimates of them."""
