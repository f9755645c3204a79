"""Contact: displacement, surface, support and law bound together."""
