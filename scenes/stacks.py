"""Bodies with non-matching cells in one mesh: stacked blocks and concentric rings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.types import Array
from scenes.bodies import Bodies, boxes
from scenes.comparison import gather, is_close
from scenes.tags import FacetSelector, any_of, at_coordinate, at_interface

COMM = MPI.COMM_WORLD
FLOOR, ROOF, LOWER, UPPER, WALL, SIDES, OUTSIDE = 1, 2, 3, 4, 5, 6, 9
E = 1e6

# ---- blocks --------------------------------------------------------------------------------------


def stack(
    cell: str,
    counts: Sequence[int],
    heights: Sequence[float],
    *,
    widths: Sequence[float] | None = None,
    gap: float = 0.0,
    degree: int = 1,
    nu: float = 0.0,
    tags: Mapping[int, FacetSelector] | None = None,
) -> Bodies:
    """Return stacked blocks with ``counts`` cells along x, and gaps of ``gap`` between them.

    Tags: FLOOR, ROOF, SIDES (all vertical faces), and 10 j + LOWER and 10 j + UPPER for the faces
    below and above joint j, numbered from 1 at the top of the lowest block.
    """
    d = 3 if cell == "hexahedron" else 2
    widths = widths or [1.0] * len(counts)
    axes, low, marks = [], 0.0, {}
    for j, (n, height, width) in enumerate(zip(counts, heights, widths, strict=True)):
        across = np.linspace((1 - width) / 2, (1 + width) / 2, n + 1)
        up = np.linspace(low, low + height, max(1, round(n * height / width)) + 1)
        axes.append([across] * (d - 1) + [up])
        if j:
            marks[10 * j + UPPER] = at_interface(d - 1, low, above=True)
        low += height
        if j + 1 < len(counts):
            marks[10 * (j + 1) + LOWER] = at_interface(d - 1, low, above=False)
            low += gap
    ends = [at_coordinate(i, v) for i in range(d - 1) for v in (0.0, 1.0)]
    marks = {
        FLOOR: at_coordinate(d - 1, 0),
        ROOF: at_coordinate(d - 1, low),
        SIDES: any_of(*ends),
        **marks,
    }
    made = boxes(axes, marks | (tags or {}), simplex=cell == "triangle")
    return Bodies(made, E, nu, degree=degree)


def joint(body: Bodies, j: int, law: Any, *, swap: bool = False, **options: Any) -> fc.Contact:
    """Return the contact at joint ``j``; Γc is its upper face, or with ``swap`` its lower face."""
    slave, master = (LOWER, UPPER) if swap else (UPPER, LOWER)
    name = f"joint {j}"
    return body.contact(10 * j + slave, 10 * j + master, law, name=name, **options)


def floor(body: Bodies, law: Any, tag: int = FLOOR, **options: Any) -> fc.Contact:
    """Return the contact of a side with the half-space below height 0."""
    up = np.eye(body.d)[-1]
    return body.contact(tag, fc.HalfSpace(0 * up, up), law, name="floor", **options)


# ---- rings ---------------------------------------------------------------------------------------


def rings(counts: tuple[int, int], *, degree: int = 2, angle: float = 1.5) -> Bodies:
    """Return sectors of two rings with radii 10/20 and 20/40, and ``counts`` cells along the angle.

    Cells are curved if quadratic. Tags: LOWER and UPPER at the joint; FLOOR and ROOF at the ends of
    the sectors; OUTSIDE.
    """
    axes = [
        [np.linspace(0, angle, n + 1), np.linspace(*radii, 4)]
        for n, radii in zip(counts, ((10, 20), (20, 40)), strict=True)
    ]

    def bend(x: Array) -> Array:
        return np.column_stack([x[:, 1] * np.cos(x[:, 0]), x[:, 1] * np.sin(x[:, 0])])

    sides = {
        LOWER: at_interface(1, 20, above=False),
        UPPER: at_interface(1, 20, above=True),
        FLOOR: at_coordinate(0, 0),
        ROOF: at_coordinate(0, angle),
        OUTSIDE: at_coordinate(1, 40),
    }
    return Bodies(boxes(axes, sides, bend=bend, degree=degree), E, 0.3, degree=degree)


# ---- contact forces ------------------------------------------------------------------------------


def nodal_forces(contact: fc.Contact) -> tuple[Array, Array]:
    """Return the contact forces at the nodes of this rank and their coordinates, (n, d) each."""
    space = contact.u.function_space
    force = fem.Function(space)
    fc.ContactOperator(contact).add_force(force.x.petsc_vec)
    d, n = len(contact.u), space.dofmap.index_map.size_local
    return -force.x.array.reshape(-1, d)[:n], space.tabulate_dof_coordinates()[:n, :d]


def force_resultants(contact: fc.Contact) -> tuple[Array, float, float]:
    """Return sums of nodal forces, their moments about the origin and component magnitudes."""
    f, x = nodal_forces(contact)
    i = contact.surface.mesh.geometry.dim - 1
    moment = x[:, 0] * f[:, i] - x[:, i] * f[:, 0]
    return (
        COMM.allreduce(f.sum(axis=0)),
        COMM.allreduce(moment.sum()),
        COMM.allreduce(np.abs(f).sum()),
    )


def is_uniform(values: Array, expected: float, rtol: float = 1e-9) -> bool:
    """Return whether all values equal ``expected`` within ``rtol``, on all ranks."""
    values = gather(COMM, values)
    return is_close(values, np.full(values.shape, expected), rtol)
