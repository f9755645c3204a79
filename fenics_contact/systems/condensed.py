"""The system after static condensation of a linear bulk onto the retained unknowns.

Contact couples few unknowns: those of Γc and of opposite points. Eliminating all others once gives
the dense Schur complement S for all increments, and S x = g + contact forces. One back-substitution
per increment recovers the interior.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from petsc4py import PETSc

from fenics_contact.systems.condensation import Condensation
from fenics_contact.systems.dense import SumOperator, UpdatedLU
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.partition import Partition
from fenics_contact.systems.system import System
from fenics_contact.systems.unknowns import DofSubset
from fenics_contact.types import Array, Indices

__all__ = ["CondensedSystem", "is_worthwhile", "n_inexpensive", "should_retain_all"]

# Five dense matrices are stored, of 200 MB each at this number of unknowns.
_MAX_DENSE_DOFS = 5000
# A dense factorisation of fewer unknowns takes milliseconds.
_CHEAP_DOFS = 500
# Largest number of retained unknowns relative to n^((d-1)/d), the unknowns on a surface, up to
# which a dense factorisation of n_c³ flops costs a quarter of a sparse one in two dimensions
# (60 n^(3/2) flops), and a tenth in three (measured: 2.9 s for 5,334 unknowns, 2.3 s for the sparse
# factors of 29,000).
_MAX_SURFACE_RATIO = {2: 3.0, 3: 2.4}
# In the plane up to this number and ratio it costs more than that, but less than iterating on all
# unknowns. Two cylinders of `demos/fretting.py` by cells per contact half-width: all and retained
# unknowns, seconds with and without condensation for pressing without friction in one increment,
# then for shearing in 20 (25 at 16): 16: 9,724, 596: 0.7 and 1.4, 2.2 and 8.6; 20: 12,604, 736: 1.2
# and 1.9, 2.4 and 7.9; 40: 32,256, 1004, pressed mostly on all unknowns: 4.1 and 24.
_MAX_PLANE_DOFS, _MAX_PLANE_RATIO = 1200, 8.0
# Ratio to the largest number up to which retained unknowns cost little: dense factorisations take
# an eighth, and condensing again, when contact spreads, longer than a sparse one.
_INEXPENSIVE_RATIO = 0.5
# Ratio to the largest number up to which all coupled unknowns are retained: recovering the others
# takes a back-substitution per increment, which in the plane costs more than it saves.
_RETAIN_ALL_RATIO = {2: 1.0, 3: 0.5}


def is_worthwhile(n: int, n_retained: int, dimension: int) -> bool:
    """Return whether memory and cost favour condensing ``n`` unknowns onto ``n_retained``.

    In two dimensions the Schur complement costs no more than a plain factorisation (0.45 s against
    0.55 s at 104,000 unknowns, 670 retained), in three 2.3 times as much (106,000 unknowns, 768
    retained). Iterating on all unknowns mostly takes more factorisations, or as much time in
    back-substitutions.
    """
    return 0 < n_retained <= _max_dofs(n, dimension)


def _max_dofs(n: int, dimension: int) -> float:
    """Return the largest number of unknowns worth retaining."""
    surface = n ** ((dimension - 1) / dimension)
    plane = min(_MAX_PLANE_DOFS, _MAX_PLANE_RATIO * surface) if dimension == 2 else 0.0
    return min(_MAX_DENSE_DOFS, max(_CHEAP_DOFS, plane, _MAX_SURFACE_RATIO[dimension] * surface))


def n_inexpensive(n: int, dimension: int) -> int:
    """Return how many unknowns can be retained at negligible additional cost."""
    return int(max(_CHEAP_DOFS, _INEXPENSIVE_RATIO * _max_dofs(n, dimension)))


def should_retain_all(n: int, n_touched: int, dimension: int) -> bool:
    """Return whether to retain all dofs that the contacts couple, active or not."""
    return n_touched <= max(2 * _CHEAP_DOFS, _RETAIN_ALL_RATIO[dimension] * _max_dofs(n, dimension))


class CondensedSystem(System):
    """The retained unknowns, all on the first rank; the others are condensed.

    Args:
        full: The system on all unknowns.
        unknowns: The retained unknowns.
        prefix: Options prefix of the factorisation.
    """

    unknowns: DofSubset
    # A dense factorisation costs ten iterations. With fewer iterations per round L-BFGS reduces to
    # Newton's method without globalisation, which fails at a stiffness of 100 E/h.
    iterations_per_restart = 8

    def __init__(self, full: FullSystem, unknowns: DofSubset, *, prefix: str = "") -> None:
        retained = unknowns.retained
        super().__init__(
            full.u,
            unknowns,
            full.bulk,
            full.contacts,
            unknowns.gather(full.constrained[retained].astype(np.float64)) > 0.5,
            unknowns.gather_partition(full.partition),
        )
        self.ready, self.scales = False, full.scales
        self.coordinate_id = object()
        self._scaled_schur: Array | None = None  # with Dirichlet conditions, dimensionless
        self._full, self._prefix = full, prefix
        # The motions are numbered after these dofs.
        self._retained_dofs = retained[retained < unknowns.whole.n_dofs]
        self._condensation: Condensation | None = None

    def linear_solver(self, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
        """Return the options that `prepare` needs."""
        return {"ksp_type": "preonly"}

    def update(self) -> int:
        """Factor and condense the bulk's tangent. Collective."""
        stiffness = self._full.stiffness
        assert stiffness is not None
        self._condensation = self._scaled_schur = None  # release the memory first
        self.ready = False
        self._condensation = Condensation(
            stiffness,
            self.bulk,
            self.unknowns,
            self._full.constrained,
            prefix=self._prefix,
            partition=self._full.partition,
        )
        self.coordinate_id = object()
        self.ready = True
        self._full.forget()
        return 1

    @property
    def condensation(self) -> Condensation:
        """The static condensation, after `update`."""
        assert self._condensation is not None
        return self._condensation

    def state(self) -> Array:
        """Return the retained unknowns, a copy. Collective."""
        whole = self.unknowns.whole
        own = whole.joined(self.u.x.array[self._retained_dofs], self.motions())
        return self.unknowns.gather(own)

    def set_state(self, state: Array) -> None:
        """Set the retained unknowns; `complete` recovers the others. Collective."""
        own = self.unknowns.scatter(state)
        self.u.x.array[self._retained_dofs] = own[: self._retained_dofs.size]
        self.u.x.scatter_forward()
        self.set_motions(state)

    def restrict(self, state: Array) -> Array:
        """Restrict a state of all unknowns to the retained ones. Collective."""
        return self.unknowns.gather(state[self.unknowns.retained])

    def begin(self, load: Array) -> None:
        """Condense the load and the prescribed values. Collective."""
        self._full.begin(load)
        state = self._full.state()
        self.condensation.set_load(load, state)
        self.load = self.restrict(load)
        self.prescribed = self.state()[self.constrained]
        outside = load.copy(), self._full.roundoff_magnitude(state)
        for vector in outside:
            vector[self.unknowns.retained] = 0.0
        self.outside = self._full.by_body(*outside)

    def extend(self, change: Array) -> Array:
        """Extend a change to all unknowns by one back-substitution. Collective."""
        return self.condensation.extend(change)

    @property
    def pending_field(self) -> Array | None:
        """The fixed-interface solution: all unknowns with the retained ones at zero."""
        return self.condensation.particular.field

    def complete(self, field: Array | None) -> None:
        """Recover the eliminated unknowns by one back-substitution. Collective."""
        assert field is not None
        self._full.set_state(field + self.condensation.extend(self.state()))

    def bulk_force(self) -> Array:
        """Return S x - g, the residual of the bulk and of free obstacles."""
        return self.condensation.schur @ self.state() - self.condensation.particular.load

    def bulk_energy(self) -> float:
        """Return the potential of S and g, up to a constant."""
        load = self.condensation.particular.load
        return float(0.5 * (self.bulk_force() - load) @ self.state())

    @cached_property
    def _partition_of_forces(self) -> Partition:
        own, full = self.partition, self._full.partition
        return Partition(np.concatenate([own.label, full.label, own.label]), own.n_parts)

    def forces(self, bulk: Array, reaction: Array) -> Forces:
        """Return forces at x, at p and at x again, for the prescribed values.

        With u = N x + p, where p is the solution for the load at x = 0, and K symmetric, NᵀK p =
        -g_u is the part of g that prescribed values cause. The products of these forces with
        differences of these unknowns are those of K u, loads and reactions with differences of u.
        """
        x, particular = self.state(), self.condensation.particular
        force = bulk + particular.load  # S x
        internal = [force - particular.prescribed_load, particular.forces, x]
        external = [particular.load - particular.prescribed_load + reaction, particular.forces, x]
        unknowns = [x, particular.field, -particular.prescribed_load]
        u, inner, outer = (np.concatenate(part) for part in (unknowns, internal, external))
        return Forces(u, inner, outer, self._partition_of_forces)

    def forget(self) -> None:
        """Drop the solutions for earlier loads."""
        self._diagonal = None
        self._full.forget()
        if self._condensation is not None:
            self._condensation.forget()

    def matrix(self, *, symmetric: bool) -> PETSc.Mat:
        """Create an operator for the sum of S and the contact tangents."""
        n = self.unknowns.n_local
        size = (n, None)
        matrix = PETSc.Mat().createPython((size, size), SumOperator(), comm=self.unknowns.comm)
        matrix.setUp()
        return matrix

    def prepare(self, ksp: PETSc.KSP, matrix: PETSc.Mat) -> None:
        """Let a solver factor a matrix of `matrix`, with low-rank updates."""
        super().prepare(ksp, matrix)
        ksp.pc.setType("python")
        ksp.pc.setPythonContext(UpdatedLU())

    def bulk_diagonal(self) -> Array:
        """Return the diagonal of S (force/length)."""
        return np.asarray(np.diag(self.condensation.schur), dtype=np.float64)

    def fill(self, matrix: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> int:
        """Add S and contact tangents with Dirichlet conditions, dimensionless."""
        scale = self.bulk.scale
        constrained = np.flatnonzero(self.constrained)
        schur = self._scaled_schur
        if schur is None:
            schur = np.asarray(self.condensation.schur / scale, dtype=np.float64)
            schur[constrained] = schur[:, constrained] = 0.0
            schur[constrained, constrained] = 1.0
            self._scaled_schur = schur
        rows, columns, values = _entries(list(contacts))
        values = np.where(self.constrained[rows] | self.constrained[columns], 0.0, values / scale)
        matrix.getPythonContext().set_parts(schur, rows, columns, values)
        matrix.assemble()  # increments the state of the Mat
        on_diagonal = rows == columns
        added = np.bincount(rows[on_diagonal], values[on_diagonal], minlength=len(schur))
        self.diagonal = self.bulk_diagonal() + scale * added
        # The round-off of contact forces depends on it.
        diagonal = self._full.diagonal
        diagonal[self.unknowns.retained] = self.unknowns.scatter(self.diagonal)
        self._full.diagonal = diagonal
        return 0


def _entries(parts: Sequence[PETSc.Mat]) -> tuple[Indices, Indices, Array]:
    """Return rows, columns and values of the sum of matrices, which are destroyed."""
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
