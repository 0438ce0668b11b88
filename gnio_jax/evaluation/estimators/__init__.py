"""The two ways to a trajectory: through the filter, and by summing displacements."""
