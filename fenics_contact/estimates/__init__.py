"""Error estimates of a solution, and adaptive mesh refinement."""
