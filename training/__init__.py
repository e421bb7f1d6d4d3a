"""Command line, episodes, replays, benchmarks and training of exploration policies."""
