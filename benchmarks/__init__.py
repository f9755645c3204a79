"""Scripts that measure the cost of contact; `run.py` runs them and collects their results."""
