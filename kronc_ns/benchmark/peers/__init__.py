"""Other solvers of the same captures, and all of them side by side."""
