"""Which facets are opposite, what points without an opposite bear, what passes between points.

References are closed answers or invariants; the solver's tolerance on forces is 1e-9, so that
what is solved for is met to 1e-8, and what follows from the same arrays to round-off.
"""

import sys

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from running import ROOT
from scenes import close, gathered, raised_everywhere
from test_pairs import FLOOR, LOWER, ROOF, SIDES, UPPER, E, at, balance, between, joint, stack

sys.path.insert(0, str(ROOT / "verification"))

from bodies import Bodies, boxes

import fenics_contact as fc
from fenics_contact import output

COMM = MPI.COMM_WORLD
BOTH = 40

pytestmark = pytest.mark.mpi


def either(*choices):
    return lambda x, cell: np.any([choice(x, cell) for choice in choices], axis=0)


# ---- what is opposite ----------------------------------------------------------------------------


def plates(cell, thickness, apart, *, layers=2, bend=None, degree=1):
    """Plates of length 1 one over the other, BOTH on all their tops and bottoms."""
    d = 3 if cell in ("tetrahedron", "hexahedron") else 2
    axes, flats, low = [], [], 0.0
    counts = (6, 9, 7)
    for j in range(len(apart) + 1):
        high = low + thickness
        line = np.linspace(0, 1, counts[j] + 1)
        axes.append([line] * (d - 1) + [np.linspace(low, high, layers + 1)])
        flats += [low, high]
        low = high + (apart[j] if j < len(apart) else 0.0)
    marks = {BOTH: either(*(at(d - 1, v) for v in flats))}
    for j in range(len(axes)):
        marks[10 * j + LOWER] = between(d - 1, flats[2 * j + 1], above=False)
        marks[10 * j + UPPER] = between(d - 1, flats[2 * j], above=True)
    return axes, marks


@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_a_plate_is_not_opposite_its_own_back(cell, layers):
    """Plates of 0.05 lifted apart by 0.2, their tops and bottoms all in one tag: nothing acts.

    The pairs across the gap are there, and the outer faces have none.
    """
    axes, marks = plates(cell, 0.05, [0.2], layers=layers)
    marks = {BOTH: marks[BOTH]}
    body = Bodies(boxes(axes, marks, simplex=cell == "triangle"), E, 0.3)
    surface = fc.ContactSurface(body.mesh, body.tags, BOTH)
    support = fc.DeformableBody(body.tags, BOTH)
    contact = fc.Contact(body.u, surface, support, fc.Coulomb(0.3, 1e7, 1e7))
    contact.evaluate()
    assert contact.resultants().normal_force == 0.0
    points = contact.gather()
    height = points["x"][:, -1]
    inner = (height > 0.04) & (height < 0.26)
    assert np.all(np.isnan(points["gap"][~inner]))
    assert close(points["gap"][inner], np.full(inner.sum(), 0.2), 1e-12)
    assert contact.n_unpaired == np.count_nonzero(~inner)
