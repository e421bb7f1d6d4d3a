"""Common tools of all experiments: configuration, run folders, stored trials, studies and their statistics."""
