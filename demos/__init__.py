"""Scripts that each show one use of the package; run them, or import what they are made of."""
