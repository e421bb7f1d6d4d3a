"""Beliefs of the robots, independent of the simulator: readings, filters, occupancy grids and observations."""
