"""The system on the unknowns that contact touches, where the bulk is linear.

Contact acts on few unknowns, Γc's and those opposite, or those that candidates touch. With the
others eliminated, which takes one factorisation, the bulk is a dense matrix S on these (its Schur
complement), whatever the loads and conditions of the increments to come: S x = g + contact forces.
An iteration costs milliseconds, and one back-substitution at its end gives the field.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from petsc4py import PETSc

from fenics_contact.systems.condensation import Condensation
from fenics_contact.systems.dense import Sum, UpdatedLU
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.system import System
from fenics_contact.systems.unknowns import DofSubset
from fenics_contact.types import Array, Indices

__all__ = ["CondensedSystem", "all_retained", "inexpensive", "worthwhile"]

# Dense matrices of this many unknowns take 200 MB each, and there are five or so.
_LARGEST = 5000
# A dense factorisation of fewer is a matter of milliseconds: always worth it.
_SMALL = 500
# A dense factorisation, n_c³ flops, is made every few iterations, and the Schur complement costs
# more the larger it is; a sparse factorisation takes about 60 n^(3/2) flops in two dimensions and
# 4 n² in three. Up to this share of n^((d-1)/d), the size of a surface of all of the mesh, the
# dense one costs a quarter of the sparse one.
_SURFACE_SHARE = {2: 3.0, 3: 1.2}
# In the plane, up to this many and this share, it costs more than that, and less than the dozens of
# iterations that all unknowns take. Two cylinders of `demos/fretting.py`, by cells in the contact's
# half-width: all and retained unknowns, seconds condensed and not, pressed by one increment without
# friction, then sheared to and fro by 20 (25 at first):
#     16: 9,724, 596: 0.7 and 1.4, 2.2 and 8.6;  20: 12,604, 736: 1.2 and 1.9, 2.4 and 7.9;
#     40: 32,256, 1004, the pressing all but on all unknowns: 4.1 and 24.
_QUICK, _QUICK_SHARE = 1200, 8.0
# Share of these up to which what is retained is hardly felt in the cost.
_CHEAP = 0.25
# Share of these up to which all that contact touches is retained. Where some is left out every
# increment takes a back-substitution, which in the plane costs more than fewer unknowns save.
_ALL = {2: 1.0, 3: 0.5}


def worthwhile(n: int, n_retained: int, dimension: int) -> bool:
    """Whether to condense ``n`` unknowns onto ``n_retained`` by memory and cost.

    The Schur complement comes with the factorisation: in two dimensions at no more than the cost
    of a plain one (0.45 s against 0.55 s at 104,000 unknowns, 670 retained), in three at 2.3 times
    (106,000 unknowns, 768 retained). With contact the iteration on all unknowns nearly always takes
    more factorisations, or back-substitutions for the price of as many.
    """
    return 0 < n_retained <= _most(n, dimension)


def _most(n: int, dimension: int) -> float:
    """How many of ``n`` unknowns are worth to be retained."""
    surface = n ** ((dimension - 1) / dimension)
    quick = min(_QUICK, _QUICK_SHARE * surface) if dimension == 2 else 0.0
    return min(_LARGEST, max(_SMALL, quick, _SURFACE_SHARE[dimension] * surface))


def inexpensive(n: int, dimension: int) -> int:
    """How many of ``n`` unknowns cost next to nothing more than fewer when they are retained."""
    return int(max(_SMALL, _CHEAP * _most(n, dimension)))


def all_retained(n: int, n_touched: int, dimension: int) -> bool:
    """Whether to keep all that contact touches, whatever part of it may come into contact."""
    return n_touched <= max(2 * _SMALL, _ALL[dimension] * _most(n, dimension))


class CondensedSystem(System):
    """The unknowns that contact touches, on the first rank; all others are eliminated.

    Args:
        full: All unknowns of a problem.
        unknowns: Those that contact touches, or may touch in this increment.
        prefix: Of the options of the factorisation.
    """

    unknowns: DofSubset
    # A dense factorisation costs no more than ten iterations. With fewer in a round L-BFGS is
    # Newton's method without a globalisation, and fails at a stiffness of 100 E/h.
    iterations_per_round = 8

    def __init__(self, full: FullSystem, unknowns: DofSubset, *, prefix: str = "") -> None:
        retained = unknowns.retained
        super().__init__(
            full.u,
            unknowns,
            full.bulk,
            full.contacts,
            unknowns.gathered(full.constrained[retained].astype(np.float64)) > 0.5,
            unknowns.gathered(full.label[retained].astype(np.float64)).astype(np.intp),
            full.n_bodies,
        )
        self.ready, self.scales = False, full.scales
        self.coordinate_id = object()
        self._fixed: Array | None = None  # the constant part of the matrices
        self._full, self._prefix = full, prefix
        # This rank's dofs among those retained; motions are behind all of them.
        self._retained_dofs = retained[retained < unknowns.whole.n_dofs]
        self._condensation: Condensation | None = None

    def linear_solver(self, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
        """That of `prepare`."""
        return {"ksp_type": "preonly"}

    def update(self) -> int:
        """Factor and condense the bulk's tangent. Collective."""
        stiffness = self._full.stiffness
        assert stiffness is not None
        self._condensation = self._fixed = None  # their memory first
        self.ready = False
        self._condensation = Condensation(
            stiffness,
            self.bulk,
            self.unknowns,
            self._full.constrained,
            prefix=self._prefix,
            label=self._full.label,
        )
        self.coordinate_id = object()
        self.ready = True
        self._full.diagonal = self._full.bulk_diagonal()
        return 1

    @property
    def condensation(self) -> Condensation:
        """The stiffness condensed, after `update`."""
        assert self._condensation is not None
        return self._condensation

    def state(self) -> Array:
        """The present values of the unknowns retained; a copy. Collective."""
        whole = self.unknowns.whole
        mine = whole.joined(self.u.x.array[self._retained_dofs], self.motions())
        return self.unknowns.gathered(mine)

    def set_state(self, state: Array) -> None:
        """Set the unknowns retained; the others stay behind until `complete`. Collective."""
        mine = self.unknowns.scattered(state)
        self.u.x.array[self._retained_dofs] = mine[: self._retained_dofs.size]
        self.u.x.scatter_forward()
        self.set_motions(state)

    def part(self, state: Array) -> Array:
        """What of a state of all unknowns is retained. Collective."""
        return self.unknowns.gathered(state[self.unknowns.retained])

    def begin(self, load: Array) -> None:
        """Condense the load and the values prescribed. Collective."""
        self._full.begin(load)
        state = self._full.state()
        self.condensation.set_load(load, state)
        self.load = self.part(load)
        self.prescribed = self.state()[self.constrained]
        outside = load.copy(), self._full.terms(state)
        for vector in outside:
            vector[self.unknowns.retained] = 0.0
        self.outside = self._full.by_body(*outside)

    def extended(self, change: Array) -> Array:
        """One back-substitution; see `System.extended`."""
        return self.condensation.extended(change)

    @property
    def pending_field(self) -> Array | None:
        """The fixed-interface solution: eliminated displacements with the retained ones at zero."""
        return self.condensation.response.field

    def complete(self, field: Array | None) -> None:
        """One back-substitution for the unknowns eliminated."""
        assert field is not None
        self._full.set_state(field + self.condensation.extended(self.state()))

    def bulk_force(self) -> Array:
        """S x - g: the residual of the bulk and of free obstacles."""
        return self.condensation.schur @ self.state() - self.condensation.response.load

    def bulk_energy(self) -> float:
        """Potential of S and g, up to a constant."""
        load = self.condensation.response.load
        return float(0.5 * (self.bulk_force() - load) @ self.state())

    def forces(self, bulk: Array, reaction: Array) -> Forces:
        """Forces at the retained unknowns, at the field with these at rest, and prescribed values.

        With u = N x + p, p the response to the load, and K symmetric, NᵀK p = -g_u is the part of
        the prescribed values in g, and the products of these forces with differences of these
        unknowns are those of K u, of the loads and of the reactions with differences of u.
        """
        x, response = self.state(), self.condensation.response
        own = bulk + response.load  # S x
        internal = [own - response.by_values, response.forces, x]
        external = [response.load - response.by_values + reaction, response.forces, x]
        unknowns = [x, response.field, -response.by_values]
        labels = np.concatenate([self.label, self._full.label, self.label])
        u, inner, outer = (np.concatenate(part) for part in (unknowns, internal, external))
        return Forces(u, inner, outer, labels)

    def forget(self) -> None:
        """Drop the solutions for earlier loads."""
        self.diagonal[:] = 0.0
        self._full.forget()
        if self._condensation is not None:
            self._condensation.forget()
            # As `update` leaves it, also at unknowns that no matrix of contact has.
            self._full.diagonal = self._full.bulk_diagonal()

    def matrix(self, *, symmetric: bool) -> PETSc.Mat:
        """A new operator, S and contact side by side."""
        n = self.unknowns.n_local
        size = (n, None)
        matrix = PETSc.Mat().createPython((size, size), Sum(), comm=self.unknowns.comm)
        matrix.setUp()
        return matrix

    def prepare(self, ksp: PETSc.KSP, matrix: PETSc.Mat) -> None:
        """Have a solver factor a matrix of `matrix`, and correct the factors for the next ones."""
        super().prepare(ksp, matrix)
        ksp.pc.setType("python")
        ksp.pc.setPythonContext(UpdatedLU())

    def bulk_diagonal(self) -> Array:
        """See `System.bulk_diagonal`: that of S."""
        return np.asarray(np.diag(self.condensation.schur), dtype=np.float64)

    def fill(self, matrix: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> int:
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
        self.diagonal = self.bulk_diagonal() + scale * added
        # For the round-off of contact.
        self._full.diagonal[self.unknowns.retained] = self.unknowns.scattered(self.diagonal)
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
