"""Filter benchmark: speed of a filter step."""
