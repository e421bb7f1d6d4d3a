"""Training benchmark: time of a decision by part, and speed over worker processes."""
