"""What is looked at before, while and after an increment is solved."""
