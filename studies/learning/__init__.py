"""Learning: what the reward tells a learner, another learning library, and the time of training."""
