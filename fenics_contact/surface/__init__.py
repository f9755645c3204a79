"""The contact surface Γc: facets, quadrature, history fields and contact search."""
