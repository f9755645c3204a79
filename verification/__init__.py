"""Scripts that compare the package with references, at extremes, and with a second solver."""
