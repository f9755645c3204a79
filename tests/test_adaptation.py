"""Adaptive meshes reach the convergence rate of smooth stresses despite the end of contact."""

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
from scenes.comparison import assert_raised_on_all_ranks
from scenes.indented_block import AXIS, BASE, TOP, half_block, solve_indentation

COMM = MPI.COMM_WORLD


def convergence_exponent(levels: list[fc.AdaptationLevel]) -> float:
    """Return the exponent of the energy error over the number of dofs."""
    dofs, errors = [level.dofs for level in levels], [level.budget.energy for level in levels]
    return float(np.polyfit(np.log(dofs), np.log(errors), 1)[0])


def test_convergence_rate_of_the_energy_error():
    """With quadratic cells the energy error is of order 1/N, the rate of smooth stresses.

    On uniform meshes the square root of the pressure at the end of contact limits it to N^(-3/4).
    Tolerance 0.15 of the exponent, a fit over two decades of the error. The force differs from that
    of a uniform mesh of 128 x 128 squares (3.494689) by at most three times the estimate. Less than
    a quarter of the dofs of the finest uniform mesh give the same energy error (measured: 1/7).
    """
    adapted = list(fc.adapt(*half_block(4), solve_indentation, levels=9))
    uniform = list(fc.adapt(*half_block(4), solve_indentation, levels=4, share=1.0))
    assert convergence_exponent(adapted[1:]) == pytest.approx(-1.0, abs=0.15)
    assert convergence_exponent(uniform) > -0.78
    as_good = next(a for a in adapted if a.budget.energy <= uniform[-1].budget.energy)
    assert as_good.dofs < uniform[-1].dofs / 4
    last = adapted[-1].budget
    error = last.values["normal force"] / 3.494689 - 1
    assert abs(error) <= 3 * last.relative("discretisation")["normal force"]


def test_tags_and_increments_are_transferred_to_refined_meshes():
    """Tagged lengths agree to round-off (1e-12); each level solves all increments with friction."""
    levels = list(fc.adapt(*half_block(4), lambda m, t: solve_indentation(m, t, 0.3, 2), levels=3))
    for level in levels:
        ds = ufl.Measure("ds", domain=level.mesh, subdomain_data=level.facet_tags)
        one = fem.Constant(level.mesh, 1.0)
        for tag in (BASE, TOP, AXIS):
            length = global_sum(COMM, fem.assemble_scalar(fem.form(one * ds(tag))))
            assert length == pytest.approx(1.0, abs=1e-12)
        assert level.problem.increment == 2
    assert levels[0].dofs < levels[1].dofs < levels[2].dofs


def test_new_nodes_are_on_the_curved_side():
    """With `snap` new nodes have the inner radius of a ring to round-off (1e-14)."""

    def bend(x):
        return np.column_stack([(1 + x[:, 1]) * np.cos(x[:, 0]), (1 + x[:, 1]) * np.sin(x[:, 0])])

    def project(x):
        return x / np.linalg.norm(x, axis=1)[:, None]

    mesh, _ = block_mesh("triangle", n=4)
    tags = side_tags(mesh, np.ones(2))
    mesh.geometry.x[:, :2] = bend(mesh.geometry.x[:, :2])

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

    last = list(fc.adapt(mesh, tags, solve, levels=3, snap={INSIDE: project}))[-1]
    sides, radius = last.facet_tags.find(INSIDE), np.ones(0)
    if sides.size:
        nodes = dolfinx.mesh.entities_to_geometry(last.mesh, 1, sides).ravel()
        radius = np.linalg.norm(last.mesh.geometry.x[nodes], axis=1)
    worst = COMM.allreduce(float(np.abs(radius - 1).max(initial=0.0)), op=MPI.MAX)
    assert worst < 1e-14


def test_invalid_input_is_refused():
    """Unsupported cells or ghost modes and numbers out of range are refused on all ranks."""
    mesh, tags = block_mesh("quadrilateral")
    assert_raised_on_all_ranks(
        lambda: list(fc.adapt(mesh, tags, solve_indentation)), ValueError, "quadrilateral"
    )
    mesh, tags = half_block(2)
    assert_raised_on_all_ranks(
        lambda: list(fc.adapt(mesh, tags, solve_indentation, share=0.0)), ValueError, "share"
    )
    assert_raised_on_all_ranks(
        lambda: list(fc.adapt(mesh, tags, solve_indentation, levels=0)), ValueError, "levels"
    )
    mesh, tags = block_mesh("triangle", ghost_mode=GhostMode.shared_facet)
    if COMM.size > 1:
        assert_raised_on_all_ranks(
            lambda: list(fc.adapt(mesh, tags, solve_indentation)), ValueError, "GhostMode.none"
        )
