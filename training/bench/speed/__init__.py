"""Speed of a filter step, of `env.step`, and of the start-up."""
