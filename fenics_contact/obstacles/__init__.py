"""What the body presses on: rigid shapes, obstacles, another body."""
