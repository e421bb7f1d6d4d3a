"""Reports: one self-contained HTML page for each run folder, which plays the episode and needs no network."""
