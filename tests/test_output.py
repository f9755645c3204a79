"""Tests of values at points and cells, and of the comparison with references."""

from __future__ import annotations

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

from fenics_contact import output

pytestmark = pytest.mark.two_ranks


def displacement():
    mesh = dolfinx.mesh.create_unit_square(MPI.COMM_WORLD, 3, 3)
    u = fem.Function(fem.functionspace(mesh, ("Lagrange", 2, (2,))))
    u.interpolate(lambda x: np.vstack([x[0] ** 2, x[0] * x[1]]))
    return u


def test_at_node() -> None:
    """`at_node` returns the value at a node on every rank, and fails where there is no node."""
    u = displacement()
    assert output.at_node(u, (1.0, 0.5)) == pytest.approx([1.0, 0.5], abs=1e-14)
    with pytest.raises(ValueError, match="no node at"):
        output.at_node(u, (0.99, 0.5))


def test_sample() -> None:
    """`sample` has every cell once, and tensor values are those at the returned points (1e-12)."""
    u = displacement()
    x, values = output.sample(ufl.grad(u), u.function_space.mesh, 2)
    assert x.shape == (18 * 3, 2) and values.shape == (18 * 3, 2, 2)
    assert len(np.unique(x.round(9), axis=0)) == len(x)
    exact = np.stack([[2 * x[:, 0], 0 * x[:, 0]], [x[:, 1], x[:, 0]]]).transpose(2, 0, 1)
    assert values == pytest.approx(exact, abs=1e-12)
    _, scalar = output.sample(u[0], u.function_space.mesh)
    assert scalar.shape == (18,)


def test_compare() -> None:
    """Errors are relative unless the reference is zero; values out of tolerance are marked."""
    entries = output.compare(
        {"a": 1.01, "b": 1e-3, "c": 2.0}, {"a": (1.0, 0.02), "b": (0.0, 1e-2), "c": (1.0, 0.5)}
    )
    assert [e["passed"] for e in entries.values()] == [True, True, False]
    assert entries["a"]["error"] == pytest.approx(0.01)
    assert output.table(entries).count("MISSED") == 1
    assert not output.compare({"a": float("nan")}, {"a": (1.0, 0.1)})["a"]["passed"]
