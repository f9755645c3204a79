"""Elimination of the inner unknowns of a substructure by MUMPS, down to the Schur complement."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import petsc4py
from petsc4py import PETSc

from fenics_contact.systems import linear
from fenics_contact.types import Array, Indices

__all__ = ["SINGULAR", "Substructure"]

SINGULAR = (
    "static condensation failed: the bulk stiffness is singular even with the contact dofs fixed. "
    "Check that every part of the body is constrained, or use condensation=False"
)


class Substructure:
    """Factorisation of the inner unknowns of a stiffness, on this rank alone.

    Args:
        stiffness: Stiffness, (n, n), taken over.
        boundary: Numbers of the retained unknowns, ascending, (n_boundary,).
        symmetric: Whether the stiffness is symmetric.
        prefix: Options prefix of the factorisation.

    Attributes:
        schur: Schur complement, (n_boundary, n_boundary), Fortran order (force/length).

    Raises:
        RuntimeError: The stiffness is singular even with the boundary fixed.
        MemoryError: The factorisation ran out of memory.
    """

    def __init__(
        self, stiffness: PETSc.Mat, boundary: Indices, *, symmetric: bool, prefix: str = ""
    ) -> None:
        n = stiffness.getSize()[0]
        self._stiffness, self._boundary = stiffness, boundary
        self._inner = np.setdiff1d(np.arange(n), boundary, assume_unique=True)
        self._right, self._left = stiffness.createVecs()
        if not self._inner.size:
            pointers, columns, values = stiffness.getValuesCSR()
            self.schur: Array = np.zeros((n, n), order="F")
            rows = np.repeat(np.arange(n), np.diff(pointers))
            np.add.at(self.schur, (rows, columns), values)
            return
        stiffness.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        self._pc = PETSc.PC().create(stiffness.comm)
        self._pc.setOptionsPrefix(prefix)
        self._pc.setOperators(stiffness)
        self._pc.setType("cholesky" if symmetric else "lu")
        self._pc.setFactorSolverType("mumps")
        self._pc.setFromOptions()
        self._pc.setFactorSetUpSolverType()
        self._factor = self._pc.getFactorMatrix()
        # MUMPS underestimates its workspace if the Schur complement dominates.
        self._factor.setMumpsIcntl(14, 400)
        if boundary.size:
            chosen = PETSc.IS().createGeneral(boundary, comm=PETSc.COMM_SELF)
            _call_petsc("MatFactorSetSchurIS", _handle(self._factor), _handle(chosen))
        self._pc.setUp()
        error = self._factor.getMumpsInfog(1)
        if linear.is_out_of_memory(self._pc):
            raise MemoryError(
                "out of memory in the factorisation for static condensation (MUMPS error "
                f"{error}): use condensation=False, or more ranks"
            )
        self.schur = self._schur_complement() if boundary.size else np.zeros((0, 0), order="F")
        if error < 0 or not np.all(np.isfinite(self.schur)):
            raise RuntimeError(f"{SINGULAR} (MUMPS error {error})")
        # Solve with the inner unknowns only.
        self._factor.setMumpsIcntl(26, 0)

    def _schur_complement(self) -> Array:
        n = self._boundary.size
        schur, status, values = ctypes.c_void_p(), ctypes.c_int(), ctypes.POINTER(ctypes.c_double)()
        factor = _handle(self._factor)
        _call_petsc(
            "MatFactorCreateSchurComplement", factor, ctypes.byref(schur), ctypes.byref(status)
        )
        _call_petsc("MatDenseGetArrayRead", schur, ctypes.byref(values))
        array = np.ctypeslib.as_array(values, (n, n)).T.copy(order="F")
        _call_petsc("MatDenseRestoreArrayRead", schur, ctypes.byref(values))
        _call_petsc("MatDestroy", ctypes.byref(schur))
        return array

    def release(self) -> Array:
        """Return `schur` and drop it."""
        schur, self.schur = self.schur, np.zeros((0, 0))
        return schur

    def solve_fixed(self, force: Array) -> Array:
        """Return the inner unknowns under forces on them, with the boundary at zero."""
        if not self._inner.size:
            return np.zeros(0)
        self._left.array[:] = 0.0
        self._left.array[self._inner] = force
        self._factor.solve(self._left, self._right)
        return np.asarray(self._right.array_r[self._inner])

    def extend(self, boundary: Array) -> Array:
        """Return the harmonic extension of boundary values to the inner unknowns."""
        return self.solve_fixed(-self._product(self._boundary, boundary)[self._inner])

    def reaction(self, inner: Array) -> Array:
        """Return the reactions of a fixed boundary, (n_boundary,), to inner values."""
        return self._product(self._inner, inner)[self._boundary]

    def _product(self, numbers: Indices, values: Array) -> Array:
        """Multiply the stiffness by values of some unknowns, (n,)."""
        self._right.array[:] = 0.0
        self._right.array[numbers] = values
        self._stiffness.mult(self._right, self._left)
        return self._left.array_r.copy()


def _handle(item: PETSc.Object) -> ctypes.c_void_p:
    return ctypes.c_void_p(item.handle)


def _call_petsc(name: str, *arguments: Any) -> None:
    """Call a function of PETSc that petsc4py does not wrap.

    Raises:
        RuntimeError: It fails, or this PETSc does not have it.
    """
    function = getattr(ctypes.CDLL(petsc4py.PETSc.__file__), name, None)
    if function is None:
        raise RuntimeError(f"this PETSc has no {name}; use condensation=False")
    code = function(*arguments)
    if code:
        raise RuntimeError(f"PETSc's {name} failed with error {code}; use condensation=False")
