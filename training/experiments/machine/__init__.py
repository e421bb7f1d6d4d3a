"""The machine that an experiment runs on: processes and Ray clusters, signals, numerics, and the timing of calls."""
