"""Iterations and solutions of every method are independent of units."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.block_on_ball import PATH, BlockOnBall, solve_path
from scenes.blocks import layer_partitioner
from scenes.comparison import have_similar_iterations, is_close, nodal_values, point_values
from scenes.two_blocks import BOTTOM, LOWER_FACE, TOP, UPPER_FACE, two_blocks

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.mpi, pytest.mark.timeout(300)]

METHODS = (None, "lbfgs", "newton", "continuation", "alternating")
# Factors of lengths and of stresses: N-mm, SI, and two that are not powers of ten, whose products
# have other round-off.
UNITS = [(1.0, 1.0), (1e-3, 1e6), (0.7, 3.3)]
CONDENSATION = [None, False]


def assert_results_agree(results) -> None:
    """Check that iterations differ by at most one per increment, and fields by 1e-9 (round-off)."""
    for iterations, *fields in results[1:]:
        assert have_similar_iterations(iterations, results[0][0])
        for field, first in zip(fields, results[0][1:], strict=True):
            assert is_close(field, first, 1e-9)


@pytest.mark.each
@pytest.mark.parametrize("condensation", CONDENSATION)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("cell", "degree", "n"), [("quadrilateral", 1, (1, 6)), ("quadrilateral", 2, (1, 4))]
)
def test_load_reversal_is_independent_of_units(cell, degree, n, method, condensation):
    """A block is pressed on a ball, dragged in both directions, and lifted."""
    results = []
    for length, pressure in UNITS:
        setup = BlockOnBall(
            fc.Coulomb(0.3),
            cell=cell,
            degree=degree,
            # Own partitioner: the default one may partition equal meshes differently.
            mesh={
                "n": n[::-1],
                "size": length * np.ones(2),
                "partitioner": layer_partitioner(cell),
            },
            length=length,
            pressure=pressure,
            method=method,
            condensation=condensation,
        )
        steps = solve_path(setup, length)
        traction = point_values(setup.contact, setup.contact.traction) / pressure
        results.append(
            ([s.iterations for s in steps], nodal_values(setup.scene.u) / length, traction)
        )
    assert_results_agree(results)


# Without L-BFGS for Tresca's law: open points have friction, so that it takes up to 40 iterations,
# in which round-off grows to all digits of the L-BFGS pairs.
IN_SPACE = [
    (law, method)
    for law in ("cone", "polygon", "ellipse", "Tresca", "multipliers")
    for method in METHODS
    if (law, method) not in (("Tresca", "lbfgs"), ("Tresca", None))
]


@pytest.mark.each
@pytest.mark.parametrize(("law", "method"), IN_SPACE)
def test_friction_in_3d_is_independent_of_units(law, method):
    """A block in 3D is pressed and dragged, with every friction law."""
    results = []
    for length, pressure in UNITS:
        setup = BlockOnBall(
            {
                "cone": fc.Coulomb(0.3),
                "multipliers": fc.Coulomb(0.3),
                "polygon": fc.Coulomb(0.3, modes=5),
                "ellipse": fc.Coulomb(0.3, transverse_friction=0.2, direction=(1.0, 0.4, 0.0)),
                "Tresca": fc.Tresca(0.3, 20.0 * pressure),
            }[law],
            cell="hexahedron",
            mesh={
                "n": 2,
                "size": length * np.ones(3),
                "partitioner": layer_partitioner("hexahedron"),
            },
            contact={"enforcement": "augmented"} if law == "multipliers" else {},
            length=length,
            pressure=pressure,
            method=method,
        )
        steps = solve_path(setup, length, PATH[:5])
        traction = point_values(setup.contact, setup.contact.traction) / pressure
        results.append(
            ([s.iterations for s in steps], nodal_values(setup.scene.u) / length, traction)
        )
    assert_results_agree(results)


@pytest.mark.each
@pytest.mark.skipif(COMM.size > 1, reason="equal meshes are not distributed equally")
@pytest.mark.parametrize("condensation", CONDENSATION)
@pytest.mark.parametrize("method", METHODS)
def test_two_bodies_are_independent_of_units(method, condensation):
    """A block in touch with another one is pressed, and dragged in both directions."""
    results = []
    for length, pressure in UNITS:
        mesh, tags = two_blocks("triangle", (5, 4))
        mesh.geometry.x[:] *= length
        V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
        u, v = fem.Function(V), ufl.TestFunction(V)
        move = [fem.Constant(mesh, 0.0) for _ in range(2)]
        zero = fem.Constant(mesh, 0.0)
        bcs = [
            fem.dirichletbc(c, fem.locate_dofs_topological(V.sub(i), 1, tags.find(tag)), V.sub(i))
            for tag, values in ((BOTTOM, [zero, zero]), (TOP, move))
            for i, c in enumerate(values)
        ]
        body = fc.elasticity.LinearElastic(u, 1000.0 * pressure, 0.3, "plane strain")
        contact = fc.Contact(
            u,
            fc.ContactSurface(mesh, tags, UPPER_FACE),
            fc.DeformableBody(tags, LOWER_FACE),
            fc.Coulomb(0.3),
        )
        problem = fc.ContactProblem(
            body.residual(v),
            u,
            bcs=bcs,
            contacts=[contact],
            method=method,
            condensation=condensation,
        )
        iterations = []
        for side, down in PATH[:5]:
            move[0].value, move[1].value = side * length / 2, -down * length / 2
            iterations.append(problem.solve().iterations)
            problem.commit()
        traction = point_values(contact, contact.traction) / pressure
        results.append((iterations, nodal_values(u) / length, traction))
    assert_results_agree(results)
