"""The discrete equations on all unknowns, or on those retained by static condensation."""
