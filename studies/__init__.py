"""Studies of this project's own parts, which are not installed: `python -m studies.merging.alignment --help`."""
