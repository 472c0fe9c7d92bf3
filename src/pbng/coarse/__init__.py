"""The coarse space of the two-grid method: grids over the rest shape, their stiffness, and a linear solver on them."""
