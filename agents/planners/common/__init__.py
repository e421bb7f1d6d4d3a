"""Common parts of planners: frontiers that a group divides, and predicted uncertainty of poses."""
