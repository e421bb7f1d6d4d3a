"""Figure 6 of the paper: map error against particles and robots."""
