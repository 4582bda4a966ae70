"""Times of simulations, and trials of the choice of their effects."""
