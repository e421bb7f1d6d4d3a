"""Map alignment on simulated and real pairs of maps."""
