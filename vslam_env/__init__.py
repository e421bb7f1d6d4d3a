"""A PettingZoo environment in which robots that do not know where they start build one visual map together."""
