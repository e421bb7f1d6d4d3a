"""Environment benchmark: speed of `env.step` and its breakdown by part."""
