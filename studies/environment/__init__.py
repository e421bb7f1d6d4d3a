"""Studies of whole environments: cost over the size of the world, and invariants under random configurations."""
