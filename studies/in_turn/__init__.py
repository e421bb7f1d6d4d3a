"""Speed of two checkouts, and of several worlds, in alternation on a busy machine."""
