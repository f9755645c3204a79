"""Contact laws: tractions at a point of Γc as a function of gap and slip."""
