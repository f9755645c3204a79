"""Tests of results as functions on Γc, for user-defined forms and for files.

References: sums over the quadrature points, which linear functions on flat facets reproduce to
round-off (1e-12 of the largest), and the range of the values there.
"""

import numpy as np
import pytest
import ufl
from dolfinx import fem, io
from mpi4py import MPI

import fenics_contact as fc
from scenes.block_on_ball import BlockOnBall
from scenes.blocks import BOTTOM, CELLS, block
from scenes.comparison import (
    assemble_scalar,
    assert_raised_on_all_ranks,
    compile_with_maps,
    gather,
    is_close,
    shared_folder,
)

COMM = MPI.COMM_WORLD

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


@pytest.mark.parametrize("cell", CELLS)
def test_integrals_equal_sums_over_quadrature_points(cell):
    """Forms on the body's mesh have facets of all orientations; nodal values remain in range."""
    setup = BlockOnBall(cell=cell, degree=2, mesh={"n": 4, "shuffled": True})
    setup.problem.small_displacement_tolerance = np.inf
    list(fc.increments(setup.problem, setup.load, 0, 2, steps=2))
    contact, d = setup.contact, setup.scene.dim
    ds = ufl.ds(setup.scene.mesh, subdomain_data=setup.scene.tags)(BOTTOM)
    for name, values in (
        ("pressure", contact.pressure),
        ("traction", contact.traction),
        ("tangential_traction", contact.tangential_traction),
        ("gap", contact.gap),
        ("slip", contact.slip.sum(axis=1)),
        ("normal", contact.values.normal),
    ):
        computed = contact.function(name)
        n = 1 if values.ndim == 1 else d
        rows = values.reshape(-1, n)
        parts = [computed] if values.ndim == 1 else [computed[i] for i in range(d)]
        sums = [assemble_scalar(compile_with_maps(part * ds, contact), COMM) for part in parts]
        expected = COMM.allreduce(contact.measure @ rows)
        size = COMM.allreduce(contact.measure @ np.abs(rows))
        assert is_close(sums, expected, 1e-12, scale=size.max()), name
        everywhere = gather(COMM, rows)
        low, high = everywhere.min(axis=0), everywhere.max(axis=0)
        nodal = computed.x.array.reshape(-1, n)
        assert COMM.allreduce(int(np.any((nodal < low) | (nodal > high)))) == 0, name
    force = contact.resultants().normal_force
    pressure = contact.function("pressure")
    assert is_close(assemble_scalar(compile_with_maps(pressure * ds, contact), COMM), force, 1e-12)


def test_compiled_form_takes_updated_values():
    """A function in a form that is compiled once takes the values of the next state (1e-12)."""
    setup = BlockOnBall(mesh={"n": 4})
    setup.problem.small_displacement_tolerance = np.inf
    contact = setup.contact
    ds = ufl.ds(setup.scene.mesh, subdomain_data=setup.scene.tags)(BOTTOM)
    pressure, slip = contact.function("pressure"), contact.function("slip")
    form = compile_with_maps(pressure * ds, contact)
    assert assemble_scalar(form, COMM) == 0.0
    for _ in fc.increments(setup.problem, setup.load, 0, 2, steps=4):
        assert contact.function("pressure", pressure) is pressure
        contact.function("slip", into=slip)
        assert is_close(assemble_scalar(form, COMM), contact.resultants().normal_force, 1e-12)
    assert COMM.allreduce(np.max(slip.x.array, initial=0.0), op=MPI.MAX) > 0


def test_uniform_gap_is_exact_and_can_be_written(tmp_path):
    """A uniform gap has its value at every node (1e-12), and DOLFINx writes the function."""
    scene = block("tetrahedron", n=3)
    obstacle = fc.PrescribedGap(0.1, scene.vector(up=-1.0))
    gap = scene.contact(fc.Frictionless(1e3), obstacle=obstacle).function("gap")
    off = COMM.allreduce(np.abs(gap.x.array - 0.1).max(initial=0.0), op=MPI.MAX)
    assert off <= 1e-12
    path = shared_folder(tmp_path) / "gap.pvd"
    with io.VTKFile(COMM, path, "w") as file:
        file.write_function(gap)
    COMM.barrier()
    assert path.exists()


def test_wrong_arguments_are_named():
    """Errors name the wrong argument on all ranks."""
    scene = block("triangle")
    contact = scene.contact(fc.Frictionless(1e3))
    assert_raised_on_all_ranks(lambda: contact.function("heat"), ValueError, "'heat'", "'pressure'")
    assert_raised_on_all_ranks(lambda: contact.function("gap", into=3), ValueError, "into is a int")
    vector = contact.function("normal")
    assert_raised_on_all_ranks(
        lambda: contact.function("gap", into=vector), ValueError, "function('gap')"
    )
    other = fem.Function(fem.functionspace(scene.mesh, ("DG", 1)))
    assert_raised_on_all_ranks(
        lambda: contact.function("gap", into=other), ValueError, "function('gap')"
    )
