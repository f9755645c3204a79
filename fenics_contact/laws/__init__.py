"""Contact laws: what a point of Γc answers to its gap and slip."""
