"""Figure 6 of the paper: map error and step time over numbers of particles and robots."""
