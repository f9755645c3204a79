"""Obstacles: rigid bodies and opposing deformable bodies."""
