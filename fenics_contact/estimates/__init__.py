"""Errors of a solution, and meshes that make them small."""
