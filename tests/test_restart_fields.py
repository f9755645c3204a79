"""User fields in checkpoints: all kinds of them, and missing ones."""

from __future__ import annotations

import warnings

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.histories.point_matching import locate_nodes, nodal_values
from scenes.comparison import (
    assert_raised_on_all_ranks,
    gather,
    is_close,
    owned_values,
    shared_folder,
)
from scenes.elasticity import strain
from scenes.histories import BlockOnBallHistory, find_differences

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.mpi


def fields_of_all_kinds(setup: BlockOnBallHistory) -> list[fem.Function]:
    """Return functions of all kinds that can be saved."""
    mesh, submesh = setup.scene.mesh, setup.problem.contacts[0].surface.submesh
    cell = mesh.basix_cell()
    d = mesh.geometry.dim
    spaces = {
        "strain": (mesh, basix.ufl.quadrature_element(cell, value_shape=(d, d), degree=2)),
        "hardening": (mesh, basix.ufl.quadrature_element(cell, degree=2)),
        "stress": (
            mesh,
            basix.ufl.element("DG", mesh.basix_cell(), 1, shape=(d, d), symmetry=True),
        ),
        "temperature": (mesh, basix.ufl.element("Lagrange", cell, 2)),
        "velocity": (mesh, basix.ufl.element("Lagrange", cell, 3, shape=(d,))),
        "wear": (submesh, basix.ufl.element("DG", submesh.basix_cell(), 0)),
    }
    return [fem.Function(fem.functionspace(m, e), name=n) for n, (m, e) in spaces.items()]


def wave(x: np.ndarray, k: float) -> np.ndarray:
    """Return values, (n,), that differ between all points."""
    return np.sin(3.0 * k + x @ np.array([2.3, 5.1, 3.7]))


def set_field_values(fields: list[fem.Function], k: float) -> None:
    """Set values that depend on the point, the component, the adjacent cell and ``k``."""
    for i, field in enumerate(fields):
        places = locate_nodes(field.function_space)
        d = places.shape[1] // 2
        x = np.zeros((len(places), 3))
        x[:, :d] = places[:, :d] + 0.1 * places[:, d:]
        values = nodal_values(field)
        for j in range(values.shape[1]):
            values[:, j] = wave(x, k + i + 0.3 * j)
        field.x.scatter_forward()


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_fields_of_every_kind_are_saved_and_restored(cell, tmp_path):
    """Fields are saved after an increment's loop body and set at restart, with ghosts, to 1e-12."""
    path = shared_folder(tmp_path) / "state.npz"
    setup, after = BlockOnBallHistory(cell=cell, n=2), BlockOnBallHistory(cell=cell, n=2)
    fields = fields_of_all_kinds(setup)
    for step in setup.increments(checkpoint=path, state_fields=fields):
        set_field_values(fields, step.increment)
        if step.increment == 3:
            break
    fields, expected = fields_of_all_kinds(after), fields_of_all_kinds(after)
    # The loop was left in the third increment: the file has the second one.
    set_field_values(expected, 2)
    steps = after.increments(checkpoint=path, state_fields=fields)
    assert next(steps).increment == 3
    for field, reference in zip(fields, expected, strict=True):
        computed, original = field.x.array, reference.x.array
        assert is_close(gather(COMM, computed), gather(COMM, original), 1e-12), field.name
    other = BlockOnBallHistory(cell=cell, n=2)
    fields = fields_of_all_kinds(other)
    for wrong in (fields[:-1], [], fields[::-1], [*fields, other.plastic]):
        call = lambda wrong=wrong: next(  # noqa: E731
            other.increments(checkpoint=path, state_fields=wrong, on_mismatch="continue")
        )
        assert_raised_on_all_ranks(call, ValueError, str(path))


@pytest.mark.parametrize("bulk", ["linear with plastic", "nonlinear"])
def test_restart_with_plastic_strains(bulk, tmp_path):
    """A restart with a strain that grows in the loop is bitwise the same, 1e-7 on several ranks."""
    folder = shared_folder(tmp_path)

    def run(setup, path, stop=0):
        grown = fem.Expression(
            setup.plastic + 0.1 * ufl.tr(strain(setup.scene.u)),
            compat.interpolation_points(setup.plastic.function_space.element),
        )
        for step in setup.increments(2.0, checkpoint=path, state_fields=[setup.plastic]):
            previous_strain = fem.Function(setup.plastic.function_space)
            previous_strain.interpolate(grown)
            setup.plastic.x.array[:] = previous_strain.x.array
            if step.increment == stop:
                break

    uninterrupted, interrupted, after = (BlockOnBallHistory(bulk=bulk, n=4) for _ in range(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*assumed small")
        run(uninterrupted, folder / "whole.npz")
        run(interrupted, folder / "part.npz", stop=3)
        run(after, folder / "part.npz")
    assert np.abs(gather(COMM, owned_values(uninterrupted.plastic))).max() > 1e-4
    tolerance = 0.0 if COMM.size == 1 else 1e-7
    assert find_differences(after, uninterrupted, tolerance) == []
    assert is_close(
        gather(COMM, owned_values(after.plastic)),
        gather(COMM, owned_values(uninterrupted.plastic)),
        1e-7,
    )


def test_fields_missing_in_a_checkpoint_are_reported(tmp_path, caplog):
    """A field changed by the loop but not saved causes one warning, and a restart is refused."""
    path = shared_folder(tmp_path) / "state.npz"
    setup = BlockOnBallHistory(bulk="nonlinear")
    with pytest.warns(UserWarning, match="plastic in the bulk form") as warned:
        for step in setup.increments(checkpoint=path):
            setup.plastic.x.array[:] = -1e-3 * step.increment
            if step.increment == 4:
                break
    assert len([w for w in warned if "plastic" in str(w.message)]) == 1
    assert caplog.text.count("plastic in the bulk form") == (COMM.rank == 0)
    after = BlockOnBallHistory(bulk="nonlinear")
    assert_raised_on_all_ranks(lambda: next(after.increments(checkpoint=path)), ValueError, "bulk")


def test_fields_that_cannot_be_saved_are_refused(tmp_path):
    """Fields that cannot be saved are named in an error when the history is set up."""
    path = shared_folder(tmp_path) / "state.npz"
    setup = BlockOnBallHistory()
    mesh = setup.scene.mesh
    edges = fem.Function(fem.functionspace(mesh, ("RTCE", 1)), name="edges")
    bubbles = basix.ufl.element("bubble", mesh.basix_cell(), 3)  # four functions a cell
    bubbles = fem.Function(fem.functionspace(mesh, bubbles), name="bubbles")
    mixed = basix.ufl.mixed_element(
        [basix.ufl.element("Lagrange", mesh.basix_cell(), k) for k in (1, 2)]
    )
    mixed = fem.Function(fem.functionspace(mesh, mixed), name="mixed")
    for field, word in (
        (edges, "edges"),
        (bubbles, "bubbles"),
        (mixed, "mixed"),
        (mixed.sub(0), "fields[0]"),
        (setup.scene.u, "displacement"),
        (setup.scene.E, "Constant"),
    ):
        call = lambda field=field: setup.increments(checkpoint=path, state_fields=[field])  # noqa: E731
        assert_raised_on_all_ranks(call, ValueError, word)
    assert_raised_on_all_ranks(
        lambda: setup.increments(state_fields=[setup.plastic]), ValueError, "checkpoint"
    )
