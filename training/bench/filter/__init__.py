"""Speed of a filter step."""
