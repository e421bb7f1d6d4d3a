"""Data association: candidate landmarks, and the choice among them."""
