"""`ContactOperator` is immutable and independent of operators on other dofs.

Results of the operator must agree bit for bit, since two evaluations of the same numbers are
compared.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.unknowns import DofSubset, Unknowns
from scenes.elasticity import dirichlet_bc, displacement_space, residual
from scenes.two_blocks import BOTTOM, LOWER_FACE, TOP, UPPER_FACE, SlidingBlock, two_blocks

pytestmark = pytest.mark.two_ranks

COMM = MPI.COMM_WORLD
LAW = fc.Coulomb(0.3, k_n=1e7, k_t=1e6)


def operator_results(operator: ContactOperator) -> list[np.ndarray]:
    """Return results of an operator for fixed random states, tractions and stiffnesses."""
    rng = np.random.default_rng(COMM.rank)
    unknowns, n = operator.unknowns, operator.contact.quadrature.n_points
    gdim = operator.contact.surface.mesh.geometry.dim
    force = unknowns.vector()
    force.set(0.0)
    operator.add_force(force, rng.normal(size=(n, gdim)))
    matrix = operator.springs(rng.normal(size=(n, gdim, gdim)))
    values = [operator.jump(rng.normal(size=unknowns.n_local)), force.array_r.copy()]
    values += [operator.coupled_dofs.copy(), *matrix.getValuesCSR()]
    for item in (force, matrix):
        item.destroy()
    return values


def are_equal(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    """Return whether arrays are equal on all ranks."""
    is_equal = all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    return COMM.allreduce(is_equal, op=MPI.LAND)


def test_operator_is_immutable():
    """No increment, restricted law or other operator changes it; updated pairs need another."""
    slider = SlidingBlock("triangle", LAW, start=1.0, n=(8, 3))
    contact, unknowns = slider.contact, slider.problem.full.unknowns
    retained = np.arange(0, unknowns.n_dofs, 2, dtype=np.int32)
    full = ContactOperator(contact, unknowns)
    part = ContactOperator(contact, DofSubset(unknowns, retained))
    before = operator_results(full), operator_results(part)
    slider.step(0.002, 0.0)
    contact.restrict_to(np.zeros(contact.quadrature.n_points, dtype=bool))
    assert are_equal(before[0], operator_results(full)) and are_equal(
        before[1], operator_results(part)
    )
    contact.restrict_to()
    slider.step(0.002, 0.6)  # beyond the paired facets
    assert contact.contact_kinematics.updates_pairs
    assert are_equal(before[0], operator_results(full)) and are_equal(
        before[1], operator_results(part)
    )
    another = ContactOperator(contact, unknowns)
    assert not are_equal(before[0], operator_results(another))
    assert are_equal(before[0], operator_results(full))


def test_operators_on_different_dofs_are_independent():
    """Operators used in turn have the same results as alone, since contacts have no dofs."""
    mesh, tags = two_blocks("triangle", (5, 3))
    u = fem.Function(displacement_space(mesh, 1))
    contact = fc.Contact(
        u, fc.ContactSurface(mesh, tags, UPPER_FACE), fc.DeformableBody(tags, LOWER_FACE), LAW
    )
    unknowns = Unknowns(u.function_space)
    retained = np.arange(1, unknowns.n_dofs, 3, dtype=np.int32)
    full, part = (
        ContactOperator(contact, over) for over in (unknowns, DofSubset(unknowns, retained))
    )
    alone = operator_results(full), operator_results(part)
    u.interpolate(lambda x: np.vstack([0.1 * x[0], -0.2 * x[1]]))
    contact.evaluate()
    for _ in range(2):
        assert are_equal(alone[1], operator_results(part)) and are_equal(
            alone[0], operator_results(full)
        )


def test_updated_pairs_replace_the_operator_of_their_contact_only():
    """The contact with a rigid floor keeps its operator when pairs of the other change."""
    mesh, tags = two_blocks("triangle", (4, 3))
    u = fem.Function(displacement_space(mesh, 1))
    pair = fc.Contact(
        u,
        fc.ContactSurface(mesh, tags, UPPER_FACE),
        fc.DeformableBody(tags, LOWER_FACE),
        LAW,
        name="pair",
    )
    ground = fc.HalfSpace(point=(0, 0), normal=(0, 1))
    floor = fc.Contact(u, fc.ContactSurface(mesh, tags, BOTTOM), ground, LAW, name="floor")
    bcs = [dirichlet_bc(u, tags, TOP, i) for i in range(2)]
    F = residual(u, ufl.TestFunction(u.function_space), 1e6, 0.3)
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[pair, floor])
    system = problem.full
    before = system.operators
    assert all(a is b for a, b in zip(before, system.operators, strict=True))
    u.interpolate(lambda x: np.vstack([np.where(x[1] > 0.5, 0.3, 0.0), 0 * x[0]]))
    old = operator_results(before[0])
    pair.contact_kinematics.find_pairs(u, np.zeros(pair.quadrature.n_points))
    after = system.operators
    assert after[0] is not before[0] and after[1] is before[1]
    assert [operator.contact for operator in after] == [pair, floor]
    assert not are_equal(old, operator_results(after[0])) and are_equal(
        old, operator_results(before[0])
    )


def test_matrix_in_3d_has_no_entries_for_open_points():
    """The matrix is the sum of bulk and contact tangents to 1e-14 (round-off: some 1e-16).

    Its pattern has the entries of the bulk and the closed points only, whatever it contained
    before, so that a factorisation costs no more than necessary.
    """
    slider = SlidingBlock("tetrahedron", LAW, start=1.0, n=(6, 2), condensation=False)
    slider.step(0.002, 0.0)
    system, contact = slider.problem.full, slider.contact
    operator, springs = system.operators[0], contact.values.springs(1.0, 1.0)
    some = contact.places()[:, 0] < 1.5
    matrix = system.matrix(symmetric=True)
    entries = []
    for closed in (np.zeros_like(some), some, np.ones_like(some), some):
        blocks = np.where(closed[:, None, None], springs, 0.0)
        alone = system.stiffness.copy()
        part = operator.springs(blocks)
        alone.axpy(1.0, part, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        rows = np.flatnonzero(system.constrained) + alone.getOwnershipRange()[0]
        alone.zeroRowsColumns(rows.astype(PETSc.IntType), diag=system.bulk.scale)
        alone.scale(1.0 / system.bulk.scale)
        system.fill(matrix, [part])
        entries.append(matrix.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"])
        alone.axpy(-1.0, matrix, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        assert alone.norm(PETSc.NormType.FROBENIUS) < 1e-14 * matrix.norm()
        alone.destroy()
    assert entries[0] < entries[1] < entries[2] and entries[3] == entries[1]
    matrix.destroy()
