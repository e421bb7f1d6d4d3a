"""The command line, runs and replays, and the training of exploration policies."""
