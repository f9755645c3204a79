"""Load histories: increments, checkpoints, tables, reports."""
