"""Scripts that each demonstrate one use of the package; their parts can also be imported."""
