"""Elimination of unknowns: a stiffness condensed onto some of its unknowns (Schur complement)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import petsc4py
from petsc4py import PETSc

from fenics_contact.systems import linear
from fenics_contact.types import Array, Indices, Mask

__all__ = ["Condensation", "Response"]


# Directions of loads whose particular solutions are kept, and the remainder, relative to the load,
# below which a load is a combination of them.
_DIRECTIONS = 4
_SAME = 1e-14


class Condensation:
    """A stiffness with all but some of its unknowns eliminated. One rank only.

    Prescribed unknowns that are not kept are held at the values they have.

    Attributes:
        schur: The condensed stiffness, (n_kept, n_kept), Fortran order (force/length).
        response: What the load of `set_load` makes of the body with the unknowns kept at rest.
    """

    def __init__(
        self,
        stiffness: PETSc.Mat,
        constrained: Mask,
        kept: Indices,
        *,
        symmetric: bool,
        prefix: str = "",
    ) -> None:
        """Factor.

        Args:
            stiffness: Over all unknowns, without conditions, (n, n).
            constrained: Mask of the prescribed unknowns, (n,).
            kept: The unknowns to keep, ascending, (n_kept,).
            symmetric: Whether the stiffness is.
            prefix: Of the options of the factorisation.

        Raises:
            RuntimeError: The stiffness is singular even with the kept unknowns held.
            MemoryError: There is not enough.
        """
        self._stiffness, self._kept = stiffness, kept
        outside = np.ones(constrained.size, dtype=np.bool_)
        outside[kept] = False
        self._held = np.flatnonzero(outside & constrained).astype(np.int32)
        self._eliminated = np.flatnonzero(outside & ~constrained).astype(np.int32)
        self._right, self._left = stiffness.createVecs()
        self._directions: list[tuple[Array, Response]] = []
        matrix = stiffness.copy()
        diagonal = matrix.getDiagonal()
        self._scale = scale = diagonal.norm(PETSc.NormType.NORM_INFINITY)
        matrix.zeroRowsColumns(self._held, diag=scale)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        self._pc = PETSc.PC().create(stiffness.comm)
        self._pc.setOptionsPrefix(prefix)
        self._pc.setOperators(matrix)
        self._pc.setType("cholesky" if symmetric else "lu")
        self._pc.setFactorSolverType("mumps")
        self._pc.setFromOptions()
        self._pc.setFactorSetUpSolverType()
        self._factor = self._pc.getFactorMatrix()
        # MUMPS' estimate of its workspace is short where the Schur complement is most of it.
        self._factor.setMumpsIcntl(14, 400)
        chosen = PETSc.IS().createGeneral(kept, comm=PETSc.COMM_SELF)
        _call("MatFactorSetSchurIS", _object(self._factor), _object(chosen))
        self._pc.setUp()
        error = self._factor.getMumpsInfog(1)
        if linear.refused_memory(self._pc):
            raise MemoryError(
                f"condensing {constrained.size} unknowns onto {kept.size} was refused its memory "
                f"(MUMPS error {error}): use condensation=False, or several ranks"
            )
        self.schur = self._schur_complement()
        if error < 0 or not np.all(np.isfinite(self.schur)):
            raise RuntimeError(
                f"the bulk stiffness cannot be condensed onto the {kept.size} unknowns that "
                f"contact touches (MUMPS error {error}): with these held it is still singular. A "
                "part of the body may be held by nothing; or use condensation=False"
            )
        # Solutions with the kept unknowns at rest, and not of the whole.
        self._factor.setMumpsIcntl(26, 0)
        self.response = Response.none(constrained.size, kept.size)

    def _schur_complement(self) -> Array:
        n = self._kept.size
        result = PETSc.Mat().createDense((n, n), comm=PETSc.COMM_SELF)
        result.assemble()
        found, status = ctypes.c_void_p(), ctypes.c_int()
        factor = _object(self._factor)
        _call("MatFactorCreateSchurComplement", factor, ctypes.byref(found), ctypes.byref(status))
        _call("MatCopy", found, _object(result), ctypes.c_int(0))
        _call("MatDestroy", ctypes.byref(found))
        array = np.array(result.getDenseArray(readonly=True), order="F")
        result.destroy()
        return array

    def _product(self, state: Array) -> Array:
        self._right.array[:] = state
        self._stiffness.mult(self._right, self._left)
        return self._left.array_r.copy()

    def _solve(self, force: Array) -> Array:
        """Displacement of the unknowns eliminated under a force on them; zero at the others."""
        self._left.array[:] = 0.0
        self._left.array[self._eliminated] = force[self._eliminated]
        self._factor.solve(self._left, self._right)
        result = np.zeros_like(force)
        result[self._eliminated] = self._right.array_r[self._eliminated]
        return result

    def set_load(self, force: Array, state: Array) -> None:
        """Condense a load and the values prescribed.

        Args:
            force: External force on all unknowns, (n,) (force).
            state: Displacements, of which those prescribed outside of the kept count, (n,).
        """
        # The loads of a history are a few fields, each times a number: what was found for earlier
        # ones serves as far as the new one is a combination of them.
        rest: Array = np.concatenate([force, self._scale * state[self._held]])
        size = float(np.linalg.norm(rest))
        shares: list[float] = []
        for direction, _ in self._directions:
            shares.append(float(direction @ rest))
            rest -= shares[-1] * direction
        responses = [response for _, response in self._directions]
        remainder = float(np.linalg.norm(rest))
        if remainder > _SAME * size:
            known = bool(np.isfinite(remainder))
            shares.append(remainder if known else 1.0)
            scaled = np.asarray(rest / shares[-1], dtype=np.float64)
            responses.append(self._respond(scaled))
            if known:
                self._directions.append((scaled, responses[-1]))
                del self._directions[:-_DIRECTIONS]
        self.response = Response.none(force.size, self._kept.size).plus(shares, responses)

    def _respond(self, given: Array) -> Response:
        """By one back-substitution, and one more if values are prescribed and the force is none."""
        force, values = np.split(given, [self._right.getSize()])
        prescribed: Array = np.zeros_like(force)
        prescribed[self._held] = values / self._scale
        lift = self._product(prescribed) if values.any() else np.zeros_like(force)
        field = prescribed + self._solve(force - lift)
        image = self._product(field)
        load = (force - image)[self._kept]
        # Apart: the share of the prescribed values in the condensed load.
        by_values = np.zeros_like(load)
        if values.any():
            still = field if not force.any() else prescribed - self._solve(lift)
            by_values = -self._product(still)[self._kept]
        at_field = force.copy()
        at_field[self._held] = image[self._held]
        at_field[self._kept] = 0.0
        return Response(field, at_field, load, by_values)

    def forget(self) -> None:
        """Drop the solutions for earlier loads."""
        self._directions = []

    def recover(self, kept: Array, particular: Array) -> Array:
        """All unknowns, (n,).

        Args:
            kept: Those kept, (n_kept,).
            particular: The displacement with these at rest, (n,); see `Response`.
        """
        return particular + self.extended(kept)

    def extended(self, kept: Array) -> Array:
        """All unknowns without load, (n,), that follow from those kept, (n_kept,)."""
        state = np.zeros(self._right.getSize())
        state[self._kept] = kept
        return state - self._solve(self._product(state))


@dataclass
class Response:
    """Of a body to its loads and prescribed values, linear in them; the unknowns kept at rest.

    Attributes:
        field: Displacement p of all unknowns, zero at those kept, (n,).
        forces: K p at the unknowns eliminated, zero at those kept, (n,) (force).
        load: The condensed external force g, (n_kept,) (force).
        by_values: The part of it that the prescribed values make, (n_kept,) (force).
    """

    field: Array
    forces: Array
    load: Array
    by_values: Array

    @classmethod
    def none(cls, n: int, n_kept: int) -> Response:
        """To nothing."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n_kept), np.zeros(n_kept))

    def plus(self, shares: Sequence[float], others: Sequence[Response]) -> Response:
        """This and shares of others added, in place."""
        for share, other in zip(shares, others, strict=True):
            for name in ("field", "forces", "load", "by_values"):
                getattr(self, name)[:] += share * getattr(other, name)
        return self


def _object(item: PETSc.Object) -> ctypes.c_void_p:
    return ctypes.c_void_p(item.handle)


def _call(name: str, *arguments: Any) -> None:
    """A function of PETSc that petsc4py does not wrap.

    Raises:
        RuntimeError: It failed, or this PETSc does not have it.
    """
    function = getattr(ctypes.CDLL(petsc4py.PETSc.__file__), name, None)
    if function is None:
        raise RuntimeError(f"this PETSc has no {name}; use condensation=False")
    code = function(*arguments)
    if code:
        raise RuntimeError(f"PETSc's {name} failed with error {code}; use condensation=False")
