"""Contact: displacement, surface, obstacle and law bound together."""
