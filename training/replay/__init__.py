"""Replays of real logs: runners, metrics and figures."""
