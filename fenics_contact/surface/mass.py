"""L2 projections: assembly of right-hand sides and the solver for mass matrices."""

from __future__ import annotations

from dolfinx import fem, la
from petsc4py import PETSc

from fenics_contact.parallel import collective_errors
from fenics_contact.types import Array

__all__ = ["assemble_values", "create_mass_solver"]


def assemble_values(form: fem.Form, vector: la.Vector | None = None) -> Array:
    """Assemble a form, in ``vector`` if given, and return its values, with ghosts. Collective."""
    with collective_errors(form.mesh.comm):
        if vector is None:
            vector = fem.assemble_vector(form)
        else:
            vector.array[:] = 0.0
            fem.assemble_vector(vector.array, form)
    vector.scatter_reverse(la.InsertMode.add)
    vector.scatter_forward()
    return vector.array


def create_mass_solver(
    matrix: PETSc.Mat, *, rtol: float, atol: float | None = None, max_it: int | None = None
) -> PETSc.KSP:
    """Create a Jacobi-preconditioned conjugate gradient solver for a mass matrix. Collective.

    ``rtol`` and ``atol`` limit the residual; None stands for the default of PETSc.
    """
    ksp = PETSc.KSP().create(matrix.comm)
    ksp.setOperators(matrix)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.getPC().setType(PETSc.PC.Type.JACOBI)
    ksp.setTolerances(rtol=rtol, atol=atol, max_it=max_it)
    return ksp
