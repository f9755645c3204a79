"""Γc: its facets, points and fields, and what lies opposite."""
