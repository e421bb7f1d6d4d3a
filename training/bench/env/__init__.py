"""Speed of the environment, and where the time goes."""
