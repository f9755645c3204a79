"""Bodies in full contact on a curved surface with non-matching meshes: ``gap=0``.

Two concentric rings have pressure or tension on the inside. Reference: Lamé's radial stress of one
ring that consists of both, at the radius of the interface.
"""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block_mesh
from scenes.comparison import gather
from scenes.elasticity import dirichlet_bc, displacement_space

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD
INNER, MIDDLE, OUTER = 1.0, 1.5, 2.0
TIE = fc.Foundation(fc.RelativeStiffness(10.0), fc.RelativeStiffness(10.0))


def ring(n, inside, outside, degree=1):
    """Return a quarter of a ring, n quadrilaterals along it, straight or of second order."""

    def bend(x):
        angle, radius = x[:, 0] * np.pi / 2, inside + (outside - inside) * x[:, 1]
        return np.column_stack([radius * np.sin(angle), radius * np.cos(angle)])

    mesh, tags = block_mesh("quadrilateral", n=(n, 4), bend=bend if degree == 2 else None)
    if degree == 1:
        mesh.geometry.x[:, :2] = bend(mesh.geometry.x)
    return mesh, None, tags


def pressure_ratio_and_scatter(n, law, *, side=-1.0, degree=1, **options):
    """Return mean interface pressure relative to Lamé's, and its coefficient of variation.

    Args:
        n: Facets of the inner ring, which has Γc, and of the outer one.
        law: Contact law between the rings.
        side: Traction on the inner surface along its normal.
        degree: Degree of cells and displacement.
        options: Options of the contact.
    """
    parts = {
        "inner": ring(n[0], INNER, MIDDLE, degree),
        "outer": ring(n[1], MIDDLE, OUTER, degree),
    }
    joined = fc.join_meshes(parts)
    u = fem.Function(displacement_space(joined.mesh, degree))
    v = ufl.TestFunction(u.function_space)
    ds = ufl.Measure("ds", joined.mesh, subdomain_data=joined.facets)
    normal = ufl.FacetNormal(joined.mesh)
    F = LinearElastic(u, 1000.0, 0.3, "plane strain").residual(v)
    F -= side * ufl.dot(normal, v) * ds(joined.facet("inner", BOTTOM))
    planes = [(joined.facet(b, tag), i) for b in parts for tag, i in ((LEFT, 0), (RIGHT, 1))]
    bcs = [dirichlet_bc(u, joined.facets, *plane) for plane in planes]
    surface = fc.ContactSurface(joined.mesh, joined.facets, joined.facet("inner", TOP))
    opposite = fc.DeformableBody(joined.facets, joined.facet("outer", BOTTOM))
    contact = fc.Contact(u, surface, opposite, law, **options)
    fc.ContactProblem(F, u, bcs=bcs, contacts=[contact]).solve()
    p, weights = gather(COMM, contact.pressure), gather(COMM, contact.measure)
    mean = weights @ p / weights.sum()
    scatter = np.sqrt(weights @ (p - mean) ** 2 / weights.sum())
    exact = INNER**2 / (OUTER**2 - INNER**2) * (OUTER**2 / MIDDLE**2 - 1)
    return mean / (-side * exact), scatter / mean


@pytest.mark.parametrize("n", [(13, 20), (20, 13)])
def test_touching_rings_with_and_without_zero_gap(n):
    """With ``gap=0`` the mean pressure is Lamé's to 0.5 %; otherwise its error exceeds 20 %.

    The pressure scatters by less than 1 % with Γc on the coarser ring, and by 19 % (asserted: 20 %)
    with Γc on the finer one, at its facets near corners of the coarser; without ``gap=0`` by more
    than 150 %.
    """
    mean, scatter = pressure_ratio_and_scatter(n, fc.Frictionless(), gap=0)
    assert mean == pytest.approx(1.0, abs=5e-3)
    assert scatter < (0.01 if n[0] < n[1] else 0.2)
    mean, scatter = pressure_ratio_and_scatter(n, fc.Frictionless())
    assert abs(mean - 1.0) > 0.2 and scatter > 1.5


@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_pressure_scatter_is_due_to_faceting(factor):
    """With Γc on the finer ring the scatter is due to linear displacements on straight facets.

    Between its nodes the coarser facet deviates from the arc by h²/8R · u_r/R, which times k_n is a
    pressure error. The scatter is proportional to k_n (2 and 19 %) and h² (each to 10 %). With
    quadratic cells and displacements it is below 1e-3.
    """
    law = fc.Frictionless(k_n=fc.RelativeStiffness(factor))
    _, scatter = pressure_ratio_and_scatter((20, 13), law, gap=0)
    assert scatter == pytest.approx(0.02 * factor, rel=0.1)
    _, finer = pressure_ratio_and_scatter((40, 26), law, gap=0)
    assert finer == pytest.approx(scatter / 4, rel=0.1)
    for n in ((13, 20), (20, 13)):
        mean, scatter = pressure_ratio_and_scatter(n, law, gap=0, degree=2)
        assert scatter < 1e-3 and mean == pytest.approx(1.0, abs=2e-2 / factor)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_tied_rings_agree_with_one_ring(side):
    """Pressed or pulled, rings tied by 10 E/h with ``gap=0`` agree to 0.5 %, scatter below 1 %."""
    mean, scatter = pressure_ratio_and_scatter((13, 20), TIE, side=side, gap=0)
    assert mean == pytest.approx(1.0, abs=5e-3)
    assert abs(scatter) < 0.01
