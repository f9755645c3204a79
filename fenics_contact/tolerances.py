"""What is round-off, the same everywhere: below it two quantities are one, or one is none.

Each is relative: the caller says to what. Other small numbers in the package are of one operation:
a tolerance of a solver, a multiple of the machine's precision, a step of a difference.
"""

import numpy as np

from fenics_contact.types import Array, Index

__all__ = ["FLAT", "NEGLIGIBLE", "ROUND_OFF", "by_place"]

# Of numbers that are sums and differences of such numbers: forces, stiffness, work, weights.
ROUND_OFF = 1e-12
# Of the size of the mesh or a facet: places, which come from files and are computed on other ranks;
# of motions, what points feel, and of loads.
NEGLIGIBLE = 1e-9
# Of unit vectors and of the extent of facets, which some files have in single precision: a right
# angle, what is parallel or flat, the rim of a facet.
FLAT = 1e-6


def by_place(x: Array) -> Index:
    """The order of places (n, d), by their first coordinates first, whatever ranks have them.

    Places differ by round-off from one distribution to the other.
    """
    size = np.abs(x).max(initial=0.0) or 1.0
    return np.lexsort(np.round(x / (NEGLIGIBLE * size)).T[::-1])
