"""Elimination of unknowns: a stiffness condensed onto some of its unknowns (Schur complement).

By substructures: every rank eliminates what its own cells alone have (`Dissection`). The first rank
adds up what is left, dense, and eliminates the interface, which is where pieces of several ranks
meet. On one rank there is one piece, and no interface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import dolfinx
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.parallel import collective_errors, global_sum
from fenics_contact.systems.balance import Labels, by_body
from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.dissection import Dissection, Eliminated
from fenics_contact.systems.unknowns import DofSubset
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Index, Indices, Mask

__all__ = ["Condensation", "ParticularSolution"]


# Directions of loads whose particular solutions are retained.
_DIRECTIONS = 4


class Condensation:
    """A stiffness with all but some of its unknowns eliminated.

    Prescribed unknowns that are not retained are held at the values they have. The constructor is
    collective.

    Args:
        stiffness: Over all unknowns, without conditions.
        bulk: The form that it is of.
        unknowns: The unknowns to keep.
        constrained: Mask of the prescribed unknowns among all of this rank, (n_local,).
        prefix: Of the options of the factorisation.
        label: Body of every unknown of this rank, (n_local,); by default there is one body.

    Attributes:
        schur: The condensed stiffness, (n_retained, n_retained) on the first rank, Fortran order
            (force/length).
        response: What the load of `set_load` makes of the body with the unknowns retained at rest.
        directions: Loads that were solved for, scaled, and what they make of it.

    Raises:
        RuntimeError: The stiffness is singular even with the retained unknowns held.
        MemoryError: There is not enough.
    """

    def __init__(
        self,
        stiffness: PETSc.Mat,
        bulk: Bulk,
        unknowns: DofSubset,
        constrained: Mask,
        *,
        prefix: str = "",
        label: Labels | None = None,
    ) -> None:
        self._stiffness, self._unknowns, self._comm = stiffness, unknowns, unknowns.comm
        outside = np.ones(constrained.size, dtype=np.bool_)
        outside[unknowns.retained] = False
        self._held = np.flatnonzero(outside & constrained).astype(np.int32)
        label = np.zeros(constrained.size, dtype=np.intp) if label is None else label
        self._label = np.concatenate([label, label[self._held]])
        self._labels = (
            label,
            unknowns.gathered(label[unknowns.retained].astype(np.float64)).astype(int),
        )
        self._n_bodies = 1 + self._comm.allreduce(int(label.max(initial=0)), op=MPI.MAX)
        self._right, self._left = stiffness.createVecs()
        self.directions: list[tuple[Array, ParticularSolution]] = []
        self._scale = bulk.scale
        own_stiffness = bulk.own_stiffness()
        own = self._piece = _Piece.of(own_stiffness, bulk.space, unknowns, constrained)
        free = PETSc.IS().createGeneral(own.unknowns, comm=PETSc.COMM_SELF)
        with collective_errors(self._comm):
            self._dissection = Dissection(
                own_stiffness.createSubMatrix(free, free),
                own.boundary,
                own.places,
                symmetric=bulk.symmetric,
                prefix=prefix,
            )
        self._interface = _Interface(own, unknowns)
        self.schur = self._interface.merge(self._dissection.release(), symmetric=bulk.symmetric)
        self.response = ParticularSolution.none(constrained.size, unknowns.n_local)

    def _product(self, state: Array) -> Array:
        self._right.array[:] = state
        self._stiffness.mult(self._right, self._left)
        return self._left.array_r.copy()

    def _solve(self, force: Array, retained: Array) -> Array:
        """All unknowns under a force on those eliminated, (n_local,), zero if held. Collective.

        Args:
            force: At this rank's unknowns, (n_local,) (force).
            retained: Displacement of the unknowns retained, (n_retained,) on the first rank.
        """
        own, result = self._piece, np.zeros_like(force)
        applied = np.zeros(own.size)
        applied[own.inner] = force[own.unknowns[own.inner]]
        partial = self._dissection.push(applied)
        boundary, result[own.interface] = self._interface.solve(
            partial.pushed[own.boundary], force[own.interface], retained
        )
        state = self._dissection.complete(boundary, partial)
        result[own.unknowns[own.inner]] = state[own.inner]
        result[self._unknowns.retained] = self._unknowns.scattered(retained)
        return result

    def set_load(self, force: Array, state: Array) -> None:
        """Condense a load and the values prescribed. Collective.

        Args:
            force: External force on all unknowns, (n_local,) (force).
            state: Displacements; used are those prescribed at eliminated unknowns, (n_local,).
        """
        # The loads of a history are a few fields, each times a number: what was found for earlier
        # ones serves as far as the new one is a combination of them.
        rest: Array = np.concatenate([force, self._scale * state[self._held]])
        # Each body's by its own numbers: its load is small beside those on others, and is not to be
        # lost in what of these cancels.
        sizes = self._norms(rest)
        shares: list[Array] = []
        for direction, _ in self.directions:
            shares.append(self._sums(direction * rest))
            rest -= shares[-1][self._label] * direction
        responses = [response for _, response in self.directions]
        remainders = self._norms(rest)
        # Well below the round-off of K u that is excused: what is left out is found nowhere else.
        new = remainders > 0.01 * ROUND_OFF * sizes
        if new.any():
            known = bool(np.isfinite(remainders).all())
            shares.append(np.where(new, remainders, 0.0) if known else np.ones(len(new)))
            scaled = rest
            if known:
                unit = np.where(new, remainders, 1.0)[self._label]
                scaled = np.where(new[self._label], rest / unit, 0.0)
            responses.append(self._respond(scaled))
            if known:
                self.directions.append((scaled, responses[-1]))
                del self.directions[:-_DIRECTIONS]
        if responses:
            self.response = ParticularSolution.combined(shares, responses, *self._labels)
        else:
            self.response = ParticularSolution.none(force.size, self._unknowns.n_local)

    def _sums(self, values: Array) -> Array:
        """By body, (n_bodies,). Collective."""
        return global_sum(self._comm, np.bincount(self._label, values, minlength=self._n_bodies))

    def _norms(self, values: Array) -> Array:
        """Of forces, and values held, on every body, (n_bodies,). Collective."""
        return by_body(self._comm, [values], self._label, self._n_bodies)[0]

    def _respond(self, given: Array) -> ParticularSolution:
        """By one back-substitution, and one more if values are prescribed and the force is none."""
        force, values = np.split(given, [self._right.getLocalSize()])
        has_values, has_force = global_sum(self._comm, [values.any(), force.any()]) > 0
        prescribed: Array = np.zeros_like(force)
        prescribed[self._held] = values / self._scale
        lift = self._product(prescribed) if has_values else np.zeros_like(force)
        at_rest = np.zeros(self._unknowns.n_local)
        field = prescribed + self._solve(force - lift, at_rest)
        image = self._product(field)
        retained = self._unknowns.retained
        load = self._unknowns.gathered((force - image)[retained])
        # Apart: the share of the prescribed values in the condensed load.
        by_values = np.zeros_like(load)
        if has_values:
            still = field if not has_force else prescribed - self._solve(lift, at_rest)
            by_values = -self._unknowns.gathered(self._product(still)[retained])
        at_field = force.copy()
        at_field[self._held] = image[self._held]
        at_field[retained] = 0.0
        return ParticularSolution(field, at_field, load, by_values)

    def forget(self) -> None:
        """Drop the solutions for earlier loads."""
        self.directions = []

    def extended(self, retained: Array) -> Array:
        """All unknowns without load, (n_local,), that follow from those retained. Collective.

        Args:
            retained: On the first rank, (n_retained,).
        """
        return self._solve(np.zeros(self._right.getLocalSize()), retained)


@dataclass(frozen=True)
class _Piece:
    """This rank's cells: the unknowns that are free there, numbered apart.

    Attributes:
        size: Unknowns of the piece.
        unknowns: Their numbers among those of this rank, ghosts behind its own, (size,).
        inner: Those that no other rank has and that are not retained, as numbers in the piece.
        boundary: The others, likewise.
        numbers: Global numbers of these, (n_boundary,).
        places: Of all of them, (size, gdim).
        interface: Unknowns of this rank, by its numbers, at which pieces meet and that are neither
            retained nor prescribed.
    """

    unknowns: Indices
    inner: Indices
    boundary: Indices
    numbers: npt.NDArray[np.int64]
    places: Array
    interface: Indices

    @property
    def size(self) -> int:
        """Unknowns of the piece."""
        return int(self.unknowns.size)

    @classmethod
    def of(
        cls,
        stiffness: PETSc.Mat,
        space: fem.FunctionSpace,
        unknowns: DofSubset,
        constrained: Mask,
    ) -> _Piece:
        """Number. Collective.

        Args:
            stiffness: See `Bulk.own_stiffness`.
            space: Of its dofs.
            unknowns: Those to keep.
            constrained: Mask of the prescribed unknowns among all of this rank.
        """
        n = unknowns.whole.n_dofs
        retained = np.zeros(unknowns.whole.n_local, dtype=np.bool_)
        retained[unknowns.retained] = True
        retained, constrained = retained[:n], constrained[:n]
        if unknowns.comm.size == 1:
            here = np.ones(n, dtype=np.bool_)
            shared = np.zeros(n, dtype=np.bool_)
        else:
            here = _acted_on(stiffness)
            shared = _over_ranks(space, here, add=True) > 1.5
            retained, constrained = (
                _over_ranks(space, mask) > 0.5 for mask in (retained, constrained)
            )
            here[:n] |= ~shared[:n]  # what has no stiffness at all is told by the factorisation
        free = here & (retained | ~constrained)
        chosen = np.flatnonzero(free).astype(np.int32)
        stays = (retained | shared)[chosen]
        dofmap = space.dofmap
        d = dofmap.index_map_bs
        boundary = np.flatnonzero(stays).astype(np.int32)
        nodes = dofmap.index_map.local_to_global((chosen[boundary] // d).astype(np.int32))
        interface = (shared & ~retained & ~constrained)[:n]
        return cls(
            unknowns=chosen,
            inner=np.flatnonzero(~stays).astype(np.int32),
            boundary=boundary,
            numbers=nodes.astype(np.int64) * d + chosen[boundary] % d,
            places=space.tabulate_dof_coordinates()[chosen // d, : space.mesh.geometry.dim],
            interface=np.flatnonzero(interface).astype(np.int32),
        )


def _acted_on(stiffness: PETSc.Mat) -> Mask:
    """Which rows have an entry that is not zero."""
    pointers, _, values = stiffness.getValuesCSR()
    row = np.repeat(np.arange(pointers.size - 1), np.diff(pointers))
    return np.bincount(row, values != 0.0, minlength=pointers.size - 1) > 0


def _over_ranks(space: fem.FunctionSpace, marks: Mask, *, add: bool = False) -> Array:
    """Marks at the dofs of this rank and its ghosts, as their owners have them. Collective.

    Args:
        space: Of the dofs.
        marks: At this rank's own, and at its ghosts behind if they count.
        add: Whether the owners add up what all ranks have there.
    """
    dofmap = space.dofmap
    vector = dolfinx.la.vector(dofmap.index_map, dofmap.index_map_bs)
    vector.array[: marks.size] = marks
    if add:
        vector.scatter_reverse(dolfinx.la.InsertMode.add)
    vector.scatter_forward()
    return vector.array.copy()


class _Interface:
    """Sums of the pieces at the retained unknowns and at the interface, on the first rank."""

    def __init__(self, piece: _Piece, unknowns: DofSubset) -> None:
        """Number. Collective."""
        self._comm = unknowns.comm
        shares = self._comm.allgather(unknowns.whole.first + piece.interface.astype(np.int64))
        self._counts = [share.size for share in shares]
        between = np.concatenate(shares)
        self._n_between = int(between.size)
        self._size = self._n_between + unknowns.n_global
        place = np.searchsorted(between, piece.numbers)
        found = np.zeros(place.size, dtype=np.bool_)
        inside = place < between.size
        found[inside] = between[place[inside]] == piece.numbers[inside]
        dofs = unknowns.numbers[: unknowns.first_motion]
        place[~found] = between.size + np.searchsorted(dofs, piece.numbers[~found])
        # Of every piece where its boundary is among the interface and the unknowns retained behind.
        self._places: list[Index] = self._comm.gather(place) or [place]
        self._between: Eliminated | None = None  # on the first rank

    def merge(self, schur: Array, *, symmetric: bool) -> Array:
        """Add up the pieces and eliminate the interface; what is left, on the first rank.

        Collective.
        """
        total: Array = np.zeros((0, 0), order="F")
        if self._comm.rank == 0:
            total = self._added_up(schur)
        else:
            self._comm.Send(schur.T, 0)
        with collective_errors(self._comm):
            if self._comm.rank == 0 and self._n_between:
                self._between = Eliminated(total, self._n_between, symmetric=symmetric)
                return self._between.release()
        return total

    def _added_up(self, schur: Array) -> Array:
        """On the first rank the pieces of all, of which it has one."""
        total = schur
        if self._comm.size > 1 or schur.shape[0] < self._size:
            total = np.zeros((self._size, self._size), order="F")
            total.T[np.ix_(self._places[0], self._places[0])] = schur.T
        for rank in range(1, self._comm.size):
            place = self._places[rank]
            part = np.zeros((place.size, place.size), order="F")
            self._comm.Recv(part.T, rank)
            total.T[np.ix_(place, place)] += part.T
        return total

    def solve(self, pushed: Array, force: Array, retained: Array) -> tuple[Array, Array]:
        """Displacement of boundary and interface. Collective.

        Args:
            pushed: What the inner unknowns do to the boundary of this piece, (n_boundary,).
            force: What acts at this rank's part of the interface.
            retained: Displacement of the unknowns retained, (n_retained,) on the first rank.

        Returns:
            Of the boundary of this piece, (n_boundary,), and of this rank's part of the interface.
        """
        parts, applied = self._comm.gather(pushed), np.zeros(self._n_between)
        self._comm.Gatherv(force, (applied, self._counts))
        n, state = self._n_between, np.zeros(self._size)
        if parts is not None:
            state[n:] = retained
            if self._between is not None:
                total = np.append(applied, np.zeros_like(retained))
                for place, part in zip(self._places, parts, strict=True):
                    total[place] += part
                state[:n] = self._between.at_rest(total[:n]) + self._between.carried(retained)
        return self._spread(state)

    def _spread(self, state: Array) -> tuple[Array, Array]:
        """From the first rank to the pieces, and to the owners of the interface. Collective."""
        if self._comm.size == 1:
            return state[self._places[0]], state[: self._n_between]
        first = self._comm.rank == 0
        parts = [state[place] for place in self._places] if first else None
        boundary = self._comm.scatter(parts)
        mine: Array = np.zeros(self._counts[self._comm.rank])
        self._comm.Scatterv((state[: self._n_between].copy(), self._counts), mine)
        return boundary, mine


@dataclass
class ParticularSolution:
    """Of a body to its loads and prescribed values, linear in them; the unknowns retained at rest.

    Attributes:
        field: Displacement p of all unknowns, zero at those retained, (n_local,).
        forces: K p at the unknowns eliminated, zero at those retained, (n_local,) (force).
        load: The condensed external force g, on the first rank, (n_retained,) (force).
        by_values: The part of it that the prescribed values make, likewise (force).
    """

    field: Array
    forces: Array
    load: Array
    by_values: Array

    @classmethod
    def none(cls, n: int, n_retained: int) -> ParticularSolution:
        """To nothing."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n_retained), np.zeros(n_retained))

    @classmethod
    def combined(
        cls,
        shares: Sequence[Array],
        responses: Sequence[ParticularSolution],
        label: Labels,
        retained: Labels,
    ) -> ParticularSolution:
        """The sum of shares of some, at least one.

        Args:
            shares: Of every response that of each body, (n_bodies,).
            responses: The responses.
            label: Body of every unknown, (n_local,).
            retained: That of the unknowns retained, on the first rank, (n_retained,).
        """

        def total(parts: Sequence[Array], label: Labels) -> Array:
            found = shares[0][label] * parts[0]
            for share, part in zip(shares[1:], parts[1:], strict=True):
                found += share[label] * part
            return found

        return cls(
            total([r.field for r in responses], label),
            total([r.forces for r in responses], label),
            total([r.load for r in responses], retained),
            total([r.by_values for r in responses], retained),
        )
