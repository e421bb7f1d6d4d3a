"""Tools that all experiments share: configuration, run folders, kept trials, statistics, tables, plots."""
