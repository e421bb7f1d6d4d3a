"""Scale benchmark: cost and results of exploration over the size of the world and the number of robots."""
