"""Common parts of commands: options, start and end with a run folder, progress over trials, and plans of benchmarks."""
