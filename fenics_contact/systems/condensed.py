"""The problem on the unknowns that contact touches, where the bulk is linear.

Contact acts on few unknowns, Γc's and those opposite. With the others eliminated, which takes one
factorisation, the bulk is a dense matrix S on these (its Schur complement), whatever the loads and
conditions of the increments to come: S x = g + contact forces. An iteration costs milliseconds, and
one back-substitution at its end gives the field.
"""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import petsc4py
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.systems.dense import PartlyFactored, Sum
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.full import FullSystem, Mask
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.unknowns import Selection, Unknowns

__all__ = ["Condensation", "CondensedSystem", "touched", "worthwhile"]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]
logger = logging.getLogger("fenics_contact")

# Dense matrices of this many unknowns take 200 MB each, and there are five or so.
_LARGEST = 5000
# A dense factorisation of fewer is a matter of milliseconds: always worth it.
_SMALL = 500
# A dense factorisation, n_c³ flops, is made every few iterations, and the Schur complement costs
# more the larger it is; a sparse factorisation takes about 60 n^(3/2) flops in two dimensions and
# 4 n² in three. Up to this share of n^((d-1)/d), the size of a surface of all of the mesh, the
# dense one costs a quarter of the sparse one.
_SURFACE_SHARE = {2: 3.0, 3: 1.2}
# Directions of loads whose particular solutions are kept, and the remainder, relative to the load,
# below which a load is a combination of them.
_DIRECTIONS = 4
_SAME = 1e-14


def worthwhile(n: int, n_kept: int, dimension: int) -> bool:
    """Whether to condense ``n`` unknowns onto ``n_kept`` by memory and cost.

    The Schur complement comes with the factorisation: in two dimensions at no more than the cost
    of a plain one (0.45 s against 0.55 s at 104,000 unknowns, 670 kept), in three at 2.3 times that
    (106,000 unknowns, 768 kept). With contact the iteration on all unknowns nearly always takes
    more factorisations, or back-substitutions for the price of as many.
    """
    surface = _SURFACE_SHARE[dimension] * n ** ((dimension - 1) / dimension)
    return 0 < n_kept <= min(_LARGEST, max(_SMALL, surface))


def touched(operators: Sequence[ContactOperator], unknowns: Unknowns) -> Indices:
    """The unknowns that contact feels or acts on, ascending. One rank only."""
    found = np.zeros(unknowns.n_local, dtype=np.bool_)
    found[unknowns.n_dofs :] = True
    for operator in operators:
        found[operator.touched] = True
    return np.flatnonzero(found).astype(np.int32)


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
        if compat.refused_memory(self._pc):
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


class CondensedSystem(FullSystem):
    """The unknowns that contact touches, all others eliminated."""

    # A dense factorisation costs no more than ten iterations. With fewer in a round L-BFGS is
    # Newton's method without a globalisation, and fails at a stiffness of 100 E/h.
    iterations_per_round = 8

    def __init__(self, whole: FullSystem, unknowns: Selection, *, prefix: str = "") -> None:
        """Select.

        Args:
            whole: All unknowns of a problem.
            unknowns: All of those that contact touches.
            prefix: Of the options of the factorisation.
        """
        self.u, self.unknowns, self.bulk = whole.u, unknowns, whole.bulk
        self.contacts, self.motions = whole.contacts, whole.motions
        self.constrained = whole.constrained[unknowns.kept]
        self.prescribed: Array = np.zeros(int(self.constrained.sum()))
        self.load: Array = np.zeros(unknowns.n_local)
        self.diagonal: Array = np.zeros(unknowns.n_local)
        self.label, self.n_bodies = whole.label[unknowns.kept], whole.n_bodies
        self.outside: Array = np.zeros((2, self.n_bodies))
        self.reach = whole.reach
        self._parts = self._operators = None
        self.ready = False
        self.mark = object()
        self._fixed: Array | None = None  # the constant part of the matrices
        self._places: Array | None = None
        self._whole, self._prefix = whole, prefix
        self._kept_dofs = unknowns.kept[: unknowns.n_dofs]
        self._contact_vector = unknowns.vector()
        self._condensation: Condensation | None = None

    def linear_solver(self, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
        """That of `prepare`."""
        return {"ksp_type": "preonly"}

    def update(self, stiffness: PETSc.Mat) -> int:
        """Factor and condense a new bulk tangent over all unknowns."""
        self._condensation = self._fixed = None  # their memory first
        self._condensation = Condensation(
            stiffness,
            self._whole.constrained,
            self.unknowns.kept,
            symmetric=self.bulk.symmetric,
            prefix=self._prefix,
        )
        self.mark = object()
        self.ready = True
        diagonal = stiffness.getDiagonal()
        self._whole.diagonal = diagonal.array.copy()
        diagonal.destroy()
        return 1

    @property
    def condensation(self) -> Condensation:
        """The stiffness condensed, after `update`."""
        assert self._condensation is not None
        return self._condensation

    def state(self) -> Array:
        """The present values of the unknowns kept; a copy."""
        motions = np.array([float(c.value) for c in self.motions])
        return np.concatenate([self.u.x.array[self._kept_dofs], motions])

    def set_state(self, state: Array) -> None:
        """Set the unknowns kept; the others stay behind until `complete`."""
        self.u.x.array[self._kept_dofs] = state[: self.unknowns.n_dofs]
        self._set_motions(state)

    def part(self, state: Array) -> Array:
        """What of a state of all unknowns is kept."""
        return state[self.unknowns.kept]

    def begin(self, load: Array) -> None:
        """Condense the load and the values prescribed."""
        self._whole.begin(load)
        state = self._whole.state()
        self.condensation.set_load(load, state)
        self.load = load[self.unknowns.kept]
        self.prescribed = self.state()[self.constrained]
        outside = load.copy(), self._whole.terms(state)
        for vector in outside:
            vector[self.unknowns.kept] = 0.0
        self.outside = self._whole.by_body(*outside)

    def extended(self, change: Array) -> Array:
        """See `FullSystem.extended`: one back-substitution."""
        return self.condensation.extended(change)

    @property
    def pending_field(self) -> Array | None:
        """The displacement that the load makes of the unknowns eliminated, those kept at rest."""
        return self.condensation.response.field

    def complete(self, field: Array | None) -> None:
        """One back-substitution for the unknowns eliminated."""
        assert field is not None
        self._whole.set_state(self.condensation.recover(self.state(), field))

    def bulk_force(self) -> Array:
        """S x - g: the residual of the bulk and of free supports."""
        return self.condensation.schur @ self.state() - self.condensation.response.load

    def bulk_energy(self) -> float:
        """Potential of S and g, up to a constant."""
        load = self.condensation.response.load
        return float(0.5 * (self.bulk_force() - load) @ self.state())

    def forces(self, bulk: Array, reaction: Array) -> Forces:
        """Forces at the unknowns kept, at the field with these at rest, and at prescribed values.

        With u = N x + p, p the response to the load, and K symmetric, NᵀK p = -g_u is the part of
        the prescribed values in g, and the products of these forces with differences of these
        unknowns are those of K u, of the loads and of the reactions with differences of u.
        """
        x, response = self.state(), self.condensation.response
        own = bulk + response.load  # S x
        internal = [own - response.by_values, response.forces, x]
        external = [response.load - response.by_values + reaction, response.forces, x]
        unknowns = [x, response.field, -response.by_values]
        joined = (np.concatenate(part) for part in (unknowns, internal, external))
        return Forces(*joined)

    def forget(self) -> None:
        """Drop the solutions for earlier loads."""
        if self._condensation is not None:
            self._condensation.forget()

    def matrix(self, stiffness: PETSc.Mat, *, symmetric: bool) -> PETSc.Mat:
        """A new operator, S and contact side by side."""
        n = self.unknowns.n_local
        matrix = PETSc.Mat().createPython((n, n), Sum(), comm=self.unknowns.comm)
        matrix.setUp()
        return matrix

    def prepare(self, ksp: PETSc.KSP, matrix: PETSc.Mat) -> None:
        """Have a solver factor a matrix of `matrix` where contact acts, and the rest once."""
        if self._places is None:
            gdim, space = len(self.u), self.u.function_space
            self._places = np.full((self.unknowns.n_local, gdim), np.nan)
            nodes = space.tabulate_dof_coordinates()[:, :gdim]
            self._places[: self.unknowns.n_dofs] = nodes[self._kept_dofs // gdim]
        ksp.setOperators(matrix)
        ksp.pc.setType("python")
        ksp.pc.setPythonContext(PartlyFactored(self._places))

    def fill(self, matrix: PETSc.Mat, stiffness: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> int:
        """S plus contact, conditions applied, dimensionless; no sparse factorisation."""
        scale = self.bulk.scale
        held = np.flatnonzero(self.constrained)
        fixed = self._fixed
        if fixed is None:
            fixed = np.asarray(self.condensation.schur / scale, dtype=np.float64)
            fixed[held] = fixed[:, held] = 0.0
            fixed[held, held] = 1.0
            self._fixed = fixed
        rows, columns, values = _entries(list(contacts))
        values = np.where(self.constrained[rows] | self.constrained[columns], 0.0, values / scale)
        matrix.getPythonContext().set_parts(fixed, rows, columns, values)
        matrix.assemble()  # says that it changed
        on = rows == columns
        added = np.bincount(rows[on], values[on], minlength=len(fixed))
        self.diagonal = scale * (np.diag(fixed) + added)
        self._whole.diagonal[self.unknowns.kept] = self.diagonal  # for the round-off of contact
        return 0


def _entries(parts: Sequence[PETSc.Mat]) -> tuple[Indices, Indices, Array]:
    """Rows, columns and values of the sum of matrices, which are used up."""
    if not parts:
        return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(0)
    total, *others = parts
    for part in others:
        total.axpy(1.0, part, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        part.destroy()
    pointers, columns, values = total.getValuesCSR()
    total.destroy()
    rows = np.repeat(np.arange(pointers.size - 1, dtype=np.int32), np.diff(pointers))
    return rows, columns, values


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
