"""Relative tolerances below which two quantities are equal, or one is zero."""

import numpy as np

from fenics_contact.types import Array, Index

__all__ = [
    "EVALUATION_ROUND_OFF",
    "FLAT",
    "MIN_FORCE",
    "NEGLIGIBLE",
    "ROUND_OFF",
    "UNLOADED_FORCE_RATIO",
    "sort_by_coordinates",
]

# Round-off of one evaluation, such as a distance, a traction or K u, relative to the magnitudes of
# its terms: in K u rigid motions leave up to 14 eps on random tetrahedra of degree 2, and 34 eps on
# a distorted mesh.
EVALUATION_ROUND_OFF = 40 * np.finfo(float).eps
# Sums and differences of forces, stiffness, work or weights, relative to the largest term.
ROUND_OFF = 1e-12
# Positions, relative to the size of the mesh or a facet; rigid-body motions at points, and loads.
NEGLIGIBLE = 1e-9
# Unit vectors and extents of facets, which some mesh files store in single precision: right angles,
# parallel and plane facets, the boundary of a facet.
FLAT = 1e-6
# Contact force on a rigid-body mode, relative to the load on it, below which the mode counts as
# unloaded.
UNLOADED_FORCE_RATIO = 1e-3
# Forces below this, in any units, are subnormal remainders of a load that was removed.
MIN_FORCE = np.finfo(float).tiny / np.finfo(float).eps


def sort_by_coordinates(x: Array) -> Index:
    """Return the lexicographic order of positions (n, d), up to round-off."""
    size = np.abs(x).max(initial=0.0) or 1.0
    return np.lexsort(np.round(x / (NEGLIGIBLE * size)).T[::-1])
