"""Result files, figures and animations."""
