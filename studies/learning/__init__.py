"""Learning: what the reward tells a learner, and another learning library."""
