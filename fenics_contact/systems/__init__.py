"""The equations on all unknowns, or condensed onto those that contact touches."""
