"""Common tools of all experiments: configuration, run folders, stored trials, statistics, tables, plots."""
