"""Episodes, scenarios, controllers and communication of simulated robots."""
