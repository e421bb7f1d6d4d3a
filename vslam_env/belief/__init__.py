"""What robots believe: readings, the team's filters and grids, beliefs and observations. It knows no simulator."""
