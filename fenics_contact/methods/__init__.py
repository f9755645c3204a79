"""Solution methods for the contact equations of one increment."""
