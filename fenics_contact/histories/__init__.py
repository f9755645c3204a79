"""Increments one after another, and how they go on in another run."""
