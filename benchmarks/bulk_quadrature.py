"""Compare quadrature degrees of a neo-Hookean bulk: time of the tangent, error of the residual.

UFL estimates a quadrature degree from the products in a form. For the neo-Hookean residual, with
det F and F⁻ᵀ, the estimate is several times the degree that displacements of degree p require. It
is compared with 2p + 1 on a homogeneous cube, stretched by 20 % with a varying part of 5 %, by the
time to assemble the tangent, and by the norm of the difference of the nodal forces relative to that
of the forces.

    OMP_NUM_THREADS=1 python benchmarks/bulk_quadrature.py           # three minutes
    OMP_NUM_THREADS=1 python benchmarks/bulk_quadrature.py --short
"""

from __future__ import annotations

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem import petsc
from dolfinx.mesh import CellType
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from benchmarks import timing
from fenics_contact.elasticity import NeoHookean
from scenes.elasticity import displacement_space

ESTIMATED = "UFL's estimate"


def stretch(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the displacement at positions x; both have shape (3, n)."""
    return 0.2 * x * np.array([[1.0], [-0.4], [-0.4]]) + 0.05 * np.sin(np.pi * x[[1, 2, 0]])


def study(cell: str, degree: int, n: int, repeat: int) -> list[timing.Row]:
    """Time the assembly of the tangents of one element on n cells per side."""
    mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_WORLD, n, n, n, CellType[cell])
    u = fem.Function(displacement_space(mesh, degree))
    u.interpolate(stretch)
    v = ufl.TestFunction(u.function_space)
    forces: dict[str, NDArray[np.float64]] = {}
    runs = {}
    for rule in (ESTIMATED, f"{2 * degree + 1}"):
        given = {} if rule == ESTIMATED else {"quadrature_degree": 2 * degree + 1}
        dx = ufl.Measure("dx", mesh, metadata=given)
        residual = NeoHookean(u, 1.0, 0.3, "3D").residual(v, dx=dx)
        form = fem.form(ufl.derivative(residual, u))
        matrix = petsc.assemble_matrix(form)
        matrix.assemble()
        vector = petsc.assemble_vector(fem.form(residual))
        forces[rule] = vector.array.copy()

        def assemble(matrix: PETSc.Mat = matrix, form: fem.Form = form) -> timing.Row:
            matrix.zeroEntries()
            petsc.assemble_matrix(matrix, form)
            matrix.assemble()
            return {}

        runs[rule] = assemble
    exact = forces[ESTIMATED]
    rows = timing.in_units_of(timing.measure(runs, repeat=repeat), f"{2 * degree + 1}", "ratio")
    element = {"cell": cell, "degree": degree, "dofs": exact.size}
    return [
        element
        | {"quadrature degree": row["run"], "tangent [s]": row["seconds"], "ratio": row["ratio"]}
        | {"difference": float(np.linalg.norm(forces[row["run"]] - exact) / np.linalg.norm(exact))}
        for row in rows
    ]


def main() -> None:
    """Run the benchmark and write its results."""
    arguments = timing.parser(__doc__, "bulk_quadrature").parse_args()
    if MPI.COMM_WORLD.size > 1:
        raise SystemExit("runs on one rank")
    n = 4 if arguments.short else 12
    rows: list[timing.Row] = []
    for cell in ("tetrahedron", "hexahedron"):
        for degree in (1, 2):
            rows += study(cell, degree, n // degree, arguments.repeat)
    timing.write(arguments.output, "bulk_quadrature", "Quadrature of a neo-Hookean bulk", rows)


if __name__ == "__main__":
    main()
