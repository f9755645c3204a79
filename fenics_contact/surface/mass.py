"""Functions that are found by products with others: their right-hand sides, and the solver."""

from __future__ import annotations

from dolfinx import fem, la
from petsc4py import PETSc

from fenics_contact.parallel import collective_errors
from fenics_contact.types import Array

__all__ = ["assembled", "mass_solver"]


def assembled(form: fem.Form, vector: la.Vector | None = None) -> Array:
    """Values of an assembled linear form, ghosts consistent. Collective.

    Args:
        form: What to assemble.
        vector: Where to, its values are overwritten; none: into a new one.
    """
    with collective_errors(form.mesh.comm):
        if vector is None:
            vector = fem.assemble_vector(form)
        else:
            vector.array[:] = 0.0
            fem.assemble_vector(vector.array, form)
    vector.scatter_reverse(la.InsertMode.add)
    vector.scatter_forward()
    return vector.array


def mass_solver(
    matrix: PETSc.Mat, *, rtol: float, atol: float | None = None, max_it: int | None = None
) -> PETSc.KSP:
    """Conjugate gradients by the diagonal, which is all that a mass matrix needs. Collective.

    Args:
        matrix: Symmetric and positive, or nearly so.
        rtol: Residual that ends it, relative.
        atol: Likewise, absolute; none: PETSc's own.
        max_it: Iterations that end it; none: PETSc's own.
    """
    ksp = PETSc.KSP().create(matrix.comm)
    ksp.setOperators(matrix)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.getPC().setType(PETSc.PC.Type.JACOBI)
    ksp.setTolerances(rtol=rtol, atol=atol, max_it=max_it)
    return ksp
