"""Validation of the input and verification of every solution."""
