"""Adapted meshes: the error falls at the rate of smooth stresses, though contact ends."""

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import GhostMode
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic
from fenics_contact.parallel import global_sum
from scenes.blocks import BOTTOM as INSIDE
from scenes.blocks import TOP as OUTSIDE
from scenes.blocks import block_mesh, side_tags
from scenes.comparing import raised_everywhere
from scenes.indented import AXIS, BASE, TOP, half_block, press

COMM = MPI.COMM_WORLD


def slope(levels: list[fc.AdaptationLevel]) -> float:
    """Exponent of the energy's error over the dofs."""
    dofs, errors = [level.dofs for level in levels], [level.budget.energy for level in levels]
    return float(np.polyfit(np.log(dofs), np.log(errors), 1)[0])


def test_error_over_dofs():
    """Quadratic cells: the energy's error falls as 1/N where it is made by smooth stresses.

    On uniform meshes the pressure's square root at the end of contact holds it to N^(-3/4) at best.
    The exponents to 0.15: fits over two decades of the error. And the force against that of a
    uniform mesh of 128 x 128 squares (3.494689, made once): within three times the estimate, with a
    seventh of the dofs of the uniform mesh that is as good.
    """
    adapted = list(fc.adapt(*half_block(4), press, levels=9))
    uniform = list(fc.adapt(*half_block(4), press, levels=4, share=1.0))
    assert slope(adapted[1:]) == pytest.approx(-1.0, abs=0.15)
    assert slope(uniform) > -0.78
    as_good = next(a for a in adapted if a.budget.energy <= uniform[-1].budget.energy)
    assert as_good.dofs < uniform[-1].dofs / 4
    last = adapted[-1].budget
    error = last.values["normal force"] / 3.494689 - 1
    assert abs(error) <= 3 * last.relative("discretisation")["normal force"]


def test_tags_and_history():
    """Tags are handed down, lengths kept to round-off; friction goes through all increments."""
    levels = list(fc.adapt(*half_block(4), lambda m, t: press(m, t, 0.3, 2), levels=3))
    for level in levels:
        ds = ufl.Measure("ds", domain=level.mesh, subdomain_data=level.facet_tags)
        one = fem.Constant(level.mesh, 1.0)
        for tag in (BASE, TOP, AXIS):
            length = global_sum(COMM, fem.assemble_scalar(fem.form(one * ds(tag))))
            assert length == pytest.approx(1.0, abs=1e-12)
        assert level.problem.increment == 2
    assert levels[0].dofs < levels[1].dofs < levels[2].dofs


def test_curved_sides():
    """New nodes of a curved side are put on it: a ring's inner radius is kept to round-off."""

    def bent(x):
        return np.column_stack([(1 + x[:, 1]) * np.cos(x[:, 0]), (1 + x[:, 1]) * np.sin(x[:, 0])])

    def onto(x):
        return x / np.linalg.norm(x, axis=1)[:, None]

    mesh, _ = block_mesh("triangle", n=4)
    tags = side_tags(mesh, np.ones(2))
    mesh.geometry.x[:, :2] = bent(mesh.geometry.x[:, :2])

    def solve(mesh, tags):
        V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
        u, v = fem.Function(V), ufl.TestFunction(V)
        body = LinearElastic(u, 1000.0, 0.3, "plane strain")
        top = fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(V, 1, tags.find(OUTSIDE)), V)
        surface = fc.ContactSurface(mesh, tags, INSIDE)
        x = ufl.SpatialCoordinate(mesh)
        obstacle = fc.PrescribedGap(gap=-0.01, normal=-x)
        contact = fc.Contact(u, surface, obstacle, fc.Frictionless(1e4), gap=-0.01)
        problem = fc.ContactProblem(body.residual(v), u, bcs=[top], contacts=[contact])
        problem.solve()
        return problem, body.stress, body.strain(u)

    last = list(fc.adapt(mesh, tags, solve, levels=3, snap={INSIDE: onto}))[-1]
    sides, radius = last.facet_tags.find(INSIDE), np.ones(0)
    if sides.size:
        nodes = dolfinx.mesh.entities_to_geometry(last.mesh, 1, sides).ravel()
        radius = np.linalg.norm(last.mesh.geometry.x[nodes], axis=1)
    worst = COMM.allreduce(float(np.abs(radius - 1).max(initial=0.0)), op=MPI.MAX)
    assert worst < 1e-14


def test_input():
    """Cells that cannot be split, and numbers without sense, on all ranks."""
    mesh, tags = block_mesh("quadrilateral")
    raised_everywhere(lambda: list(fc.adapt(mesh, tags, press)), ValueError, "quadrilateral")
    mesh, tags = half_block(2)
    raised_everywhere(lambda: list(fc.adapt(mesh, tags, press, share=0.0)), ValueError, "share")
    raised_everywhere(lambda: list(fc.adapt(mesh, tags, press, levels=0)), ValueError, "levels")
    mesh, tags = block_mesh("triangle", ghost_mode=GhostMode.shared_facet)
    if COMM.size > 1:
        raised_everywhere(lambda: list(fc.adapt(mesh, tags, press)), ValueError, "GhostMode.none")
