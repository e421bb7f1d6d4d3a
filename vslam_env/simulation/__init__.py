"""Episodes: a world with robots in it, their controllers, their radio, and the truth about them."""
