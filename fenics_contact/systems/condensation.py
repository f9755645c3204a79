"""Static condensation: the Schur complement of a stiffness on the retained unknowns.

Every rank eliminates the interior unknowns of its own cells (`Dissection`). The first rank adds up
the dense Schur complements and eliminates the interface between subdomains of several ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import dolfinx
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.parallel import collective_errors, global_sum
from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.dissection import BlockFactorisation, Dissection
from fenics_contact.systems.partition import Partition, norms_by_part
from fenics_contact.systems.unknowns import DofSubset
from fenics_contact.tolerances import MIN_FORCE, ROUND_OFF
from fenics_contact.types import Array, Index, Indices, Mask

__all__ = ["Condensation", "ParticularSolution"]


# Number of load directions whose particular solutions are stored.
_MAX_LOAD_DIRECTIONS = 4


class Condensation:
    """Static condensation of a stiffness onto the retained unknowns.

    Prescribed unknowns that are not retained keep their values. The constructor is collective.

    Args:
        stiffness: Stiffness over all unknowns, without Dirichlet conditions.
        bulk: The bulk form of this stiffness.
        unknowns: The retained unknowns.
        constrained: Mask of the prescribed unknowns of this rank, (n_local,).
        prefix: Options prefix of the factorisation.
        partition: Bodies of this rank's unknowns; by default there is one body.

    Attributes:
        schur: Schur complement S, (n_retained, n_retained) on the first rank, Fortran order
            (force/length).
        particular: Solution for the load of `set_load` with the retained unknowns at zero.
        load_directions: Orthonormal directions of earlier loads with their solutions.

    Raises:
        RuntimeError: The stiffness is singular even with the retained unknowns fixed.
        MemoryError: The factorisation ran out of memory.
    """

    def __init__(
        self,
        stiffness: PETSc.Mat,
        bulk: Bulk,
        unknowns: DofSubset,
        constrained: Mask,
        *,
        prefix: str = "",
        partition: Partition | None = None,
    ) -> None:
        self._stiffness, self._unknowns, self._comm = stiffness, unknowns, unknowns.comm
        outside = np.ones(constrained.size, dtype=np.bool_)
        outside[unknowns.retained] = False
        self._prescribed = np.flatnonzero(outside & constrained).astype(np.int32)
        if partition is None:
            partition = Partition(np.zeros(constrained.size, dtype=np.intp), 1)
        label = np.concatenate([partition.label, partition.label[self._prescribed]])
        # Of loads and prescribed values, of all unknowns, and of the retained ones.
        self._of_loads = Partition(label, partition.n_parts)
        self._partitions = partition, unknowns.gather_partition(partition)
        self._right, self._left = stiffness.createVecs()
        self.load_directions: list[tuple[Array, ParticularSolution]] = []
        self._scale = bulk.scale
        own_stiffness = bulk.own_stiffness()
        domain = self._subdomain = _Subdomain.build(
            own_stiffness, bulk.space, unknowns, constrained
        )
        free = PETSc.IS().createGeneral(domain.unknowns, comm=PETSc.COMM_SELF)
        with collective_errors(self._comm):
            self._dissection = Dissection(
                own_stiffness.createSubMatrix(free, free),
                domain.boundary,
                domain.coordinates,
                symmetric=bulk.symmetric,
                prefix=prefix,
            )
        self._interface = _Interface(domain, unknowns)
        self.schur = self._interface.merge(self._dissection.release(), symmetric=bulk.symmetric)
        self.particular = ParticularSolution.zero(constrained.size, unknowns.n_local)

    def _product(self, state: Array) -> Array:
        self._right.array[:] = state
        self._stiffness.mult(self._right, self._left)
        return self._left.array_r.copy()

    def _solve(self, force: Array, retained: Array) -> Array:
        """Solve for all unknowns, (n_local,), zero at prescribed ones. Collective.

        Args:
            force: Forces at this rank's eliminated unknowns, (n_local,) (force).
            retained: Values of the retained unknowns, (n_retained,) on the first rank.
        """
        domain, result = self._subdomain, np.zeros_like(force)
        applied = np.zeros(domain.size)
        applied[domain.inner] = force[domain.unknowns[domain.inner]]
        partial = self._dissection.eliminate(applied)
        boundary, result[domain.interface] = self._interface.solve(
            partial.reduced_rhs[domain.boundary], force[domain.interface], retained
        )
        state = self._dissection.back_substitute(boundary, partial)
        result[domain.unknowns[domain.inner]] = state[domain.inner]
        result[self._unknowns.retained] = self._unknowns.scatter(retained)
        return result

    def set_load(self, force: Array, state: Array) -> None:
        """Condense a load and the prescribed values. Collective.

        Args:
            force: External forces on all unknowns, (n_local,) (force).
            state: Unknowns, of which the prescribed, eliminated ones are used, (n_local,).
        """
        # A load history mostly combines a few load cases: their solutions are stored, and only the
        # component orthogonal to them is solved for.
        remainder: Array = np.concatenate([force, self._scale * state[self._prescribed]])
        # Coefficients by body, so that a small load on one body is not lost in round-off of others.
        sizes = self._norm_by_body(remainder)
        coefficients: list[Array] = []
        for direction, _ in self.load_directions:
            products = self._of_loads.products(direction, remainder)
            coefficients.append(global_sum(self._comm, products))
            remainder -= self._of_loads.scale(direction, coefficients[-1])
        solutions = [solution for _, solution in self.load_directions]
        norms = self._norm_by_body(remainder)
        # A neglected remainder appears in no residual: it must be well below the tolerance of K u.
        new = norms > np.maximum(0.01 * ROUND_OFF * sizes, MIN_FORCE)
        if new.any():
            is_finite = bool(np.isfinite(norms).all())
            coefficients.append(np.where(new, norms, 0.0) if is_finite else np.ones(len(new)))
            scaled = remainder
            if is_finite:
                factors = np.where(new, 1.0 / np.where(new, norms, 1.0), 0.0)
                scaled = self._of_loads.scale(remainder, factors)
            solutions.append(self._solve_load(scaled))
            if is_finite:
                self.load_directions.append((scaled, solutions[-1]))
                del self.load_directions[:-_MAX_LOAD_DIRECTIONS]
        if solutions:
            self.particular = ParticularSolution.combine(coefficients, solutions, *self._partitions)
        else:
            self.particular = ParticularSolution.zero(force.size, self._unknowns.n_local)

    def _norm_by_body(self, values: Array) -> Array:
        """Return the norms of forces and scaled prescribed values by body. Collective."""
        partition = self._of_loads
        return norms_by_part(self._comm, partition.n_parts, [(values, partition)]).ravel()

    def _solve_load(self, direction: Array) -> ParticularSolution:
        """Return the solution for a load direction by one or two back-substitutions. Collective.

        The second one is needed if there are both forces and prescribed values.
        """
        force, values = np.split(direction, [self._right.getLocalSize()])
        has_values, has_force = global_sum(self._comm, [values.any(), force.any()]) > 0
        prescribed: Array = np.zeros_like(force)
        prescribed[self._prescribed] = values / self._scale
        lift = self._product(prescribed) if has_values else np.zeros_like(force)
        zero = np.zeros(self._unknowns.n_local)
        field = prescribed + self._solve(force - lift, zero)
        forces = self._product(field)
        retained = self._unknowns.retained
        load = self._unknowns.gather((force - forces)[retained])
        # Separate the part of the prescribed values for the energy balance.
        prescribed_load = np.zeros_like(load)
        if has_values:
            fixed = field if not has_force else prescribed - self._solve(lift, zero)
            prescribed_load = -self._unknowns.gather(self._product(fixed)[retained])
        at_field = force.copy()
        at_field[self._prescribed] = forces[self._prescribed]
        at_field[retained] = 0.0
        return ParticularSolution(field, at_field, load, prescribed_load)

    def forget(self) -> None:
        """Drop the solutions for earlier loads."""
        self.load_directions = []

    def extend(self, retained: Array) -> Array:
        """Return the harmonic extension of the retained unknowns, (n_local,). Collective."""
        return self._solve(np.zeros(self._right.getLocalSize()), retained)


@dataclass(frozen=True)
class _Subdomain:
    """The free unknowns of this rank's cells, in a numbering of their own.

    Attributes:
        unknowns: Their numbers on this rank, ghosts last, (size,).
        inner: Numbers in the subdomain of those on no other rank and not retained.
        boundary: Numbers in the subdomain of all others.
        numbers: Global numbers of the boundary, (n_boundary,).
        coordinates: Coordinates of the nodes of all, (size, gdim).
        interface: Numbers on this rank of its own unknowns that several subdomains share and that
            are neither retained nor prescribed.
    """

    unknowns: Indices
    inner: Indices
    boundary: Indices
    numbers: npt.NDArray[np.int64]
    coordinates: Array
    interface: Indices

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.unknowns.size)

    @classmethod
    def build(
        cls,
        stiffness: PETSc.Mat,
        space: fem.FunctionSpace,
        unknowns: DofSubset,
        constrained: Mask,
    ) -> _Subdomain:
        """Number the unknowns of `Bulk.own_stiffness`. Collective."""
        n = unknowns.whole.n_dofs
        retained = np.zeros(unknowns.whole.n_local, dtype=np.bool_)
        retained[unknowns.retained] = True
        retained, constrained = retained[:n], constrained[:n]
        if unknowns.comm.size == 1:
            is_local = np.ones(n, dtype=np.bool_)
            shared = np.zeros(n, dtype=np.bool_)
        else:
            is_local = _find_nonzero_rows(stiffness)
            shared = _update_ghosts(space, is_local, add=True) > 1.5
            retained, constrained = (
                _update_ghosts(space, mask) > 0.5 for mask in (retained, constrained)
            )
            is_local[:n] |= ~shared[:n]  # the factorisation reports a zero stiffness
        free = is_local & (retained | ~constrained)
        free_dofs = np.flatnonzero(free).astype(np.int32)
        is_boundary = (retained | shared)[free_dofs]
        dofmap = space.dofmap
        d = dofmap.index_map_bs
        boundary = np.flatnonzero(is_boundary).astype(np.int32)
        nodes = dofmap.index_map.local_to_global((free_dofs[boundary] // d).astype(np.int32))
        interface = (shared & ~retained & ~constrained)[:n]
        return cls(
            unknowns=free_dofs,
            inner=np.flatnonzero(~is_boundary).astype(np.int32),
            boundary=boundary,
            numbers=nodes.astype(np.int64) * d + free_dofs[boundary] % d,
            coordinates=space.tabulate_dof_coordinates()[free_dofs // d, : space.mesh.geometry.dim],
            interface=np.flatnonzero(interface).astype(np.int32),
        )


def _find_nonzero_rows(stiffness: PETSc.Mat) -> Mask:
    """Return the mask of the rows with a nonzero entry."""
    pointers, _, values = stiffness.getValuesCSR()
    row = np.repeat(np.arange(pointers.size - 1), np.diff(pointers))
    return np.bincount(row, values != 0.0, minlength=pointers.size - 1) > 0


def _update_ghosts(space: fem.FunctionSpace, mask: Mask, *, add: bool = False) -> Array:
    """Return a mask at this rank's dofs and ghosts as their owners have it. Collective.

    With ``add`` the owners sum up the values of all ranks, ghosts included.
    """
    dofmap = space.dofmap
    vector = dolfinx.la.vector(dofmap.index_map, dofmap.index_map_bs)
    vector.array[: mask.size] = mask
    if add:
        vector.scatter_reverse(dolfinx.la.InsertMode.add)
    vector.scatter_forward()
    return vector.array.copy()


class _Interface:
    """The assembled Schur complements of all subdomains, on the first rank."""

    def __init__(self, domain: _Subdomain, unknowns: DofSubset) -> None:
        """Number the interface, then the retained unknowns. Collective."""
        self._comm = unknowns.comm
        parts = self._comm.allgather(unknowns.whole.first + domain.interface.astype(np.int64))
        self._counts = [part.size for part in parts]
        interface = np.concatenate(parts)
        self._n_interface = int(interface.size)
        self._size = self._n_interface + unknowns.n_global
        position = np.searchsorted(interface, domain.numbers)
        shared = np.zeros(position.size, dtype=np.bool_)
        in_range = position < interface.size
        shared[in_range] = interface[position[in_range]] == domain.numbers[in_range]
        dofs = unknowns.numbers[: unknowns.first_motion]
        position[~shared] = interface.size + np.searchsorted(dofs, domain.numbers[~shared])
        # Positions of each boundary in the interface followed by the retained unknowns.
        self._positions: list[Index] = self._comm.gather(position) or [position]
        self._factors: BlockFactorisation | None = None  # on the first rank

    def merge(self, schur: Array, *, symmetric: bool) -> Array:
        """Return S on the first rank, after elimination of the interface. Collective."""
        total: Array = np.zeros((0, 0), order="F")
        if self._comm.rank == 0:
            total = self._assemble(schur)
        else:
            self._comm.Send(schur.T, 0)
        with collective_errors(self._comm):
            if self._comm.rank == 0 and self._n_interface:
                self._factors = BlockFactorisation(total, self._n_interface, symmetric=symmetric)
                return self._factors.release()
        return total

    def _assemble(self, schur: Array) -> Array:
        """Return the sum of the Schur complements of all ranks, on the first rank."""
        total = schur
        if self._comm.size > 1 or schur.shape[0] < self._size:
            total = np.zeros((self._size, self._size), order="F")
            total.T[np.ix_(self._positions[0], self._positions[0])] = schur.T
        for rank in range(1, self._comm.size):
            position = self._positions[rank]
            part = np.zeros((position.size, position.size), order="F")
            self._comm.Recv(part.T, rank)
            total.T[np.ix_(position, position)] += part.T
        return total

    def solve(self, reduced_rhs: Array, force: Array, retained: Array) -> tuple[Array, Array]:
        """Solve for the boundary and the interface. Collective.

        Args:
            reduced_rhs: Forces on the boundary after elimination of the inner unknowns,
                (n_boundary,).
            force: Forces on this rank's part of the interface.
            retained: Values of the retained unknowns, (n_retained,) on the first rank.

        Returns:
            Values at the boundary, (n_boundary,), and at this rank's part of the interface.
        """
        parts, applied = self._comm.gather(reduced_rhs), np.zeros(self._n_interface)
        self._comm.Gatherv(force, (applied, self._counts))
        n, state = self._n_interface, np.zeros(self._size)
        if parts is not None:
            state[n:] = retained
            if self._factors is not None:
                total = np.append(applied, np.zeros_like(retained))
                for position, part in zip(self._positions, parts, strict=True):
                    total[position] += part
                state[:n] = self._factors.solve_fixed(total[:n]) + self._factors.extend(retained)
        return self._distribute(state)

    def _distribute(self, state: Array) -> tuple[Array, Array]:
        """Scatter the solution to the subdomains and to owners. Collective."""
        if self._comm.size == 1:
            return state[self._positions[0]], state[: self._n_interface]
        first = self._comm.rank == 0
        parts = [state[position] for position in self._positions] if first else None
        boundary = self._comm.scatter(parts)
        interface: Array = np.zeros(self._counts[self._comm.rank])
        self._comm.Scatterv((state[: self._n_interface].copy(), self._counts), interface)
        return boundary, interface


@dataclass
class ParticularSolution:
    """The solution p for loads and prescribed values with the retained unknowns at zero.

    Attributes:
        field: The solution p at all unknowns, (n_local,).
        forces: K p at the eliminated unknowns, zero at the retained ones, (n_local,) (force).
        load: The condensed load g, on the first rank, (n_retained,) (force).
        prescribed_load: Part of g that is due to prescribed values, (n_retained,) (force).
    """

    field: Array
    forces: Array
    load: Array
    prescribed_load: Array

    @classmethod
    def zero(cls, n: int, n_retained: int) -> ParticularSolution:
        """Return the solution without load."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n_retained), np.zeros(n_retained))

    @classmethod
    def combine(
        cls,
        coefficients: Sequence[Array],
        solutions: Sequence[ParticularSolution],
        whole: Partition,
        retained: Partition,
    ) -> ParticularSolution:
        """Return a linear combination of solutions with coefficients by body, (n_bodies,) each.

        The partitions are those of all unknowns and of the retained ones.
        """

        def total(parts: Sequence[Array], partition: Partition) -> Array:
            terms = zip(parts, coefficients, strict=True)
            first, *others = (partition.scale(part, factors) for part, factors in terms)
            return sum(others, first)

        return cls(
            total([r.field for r in solutions], whole),
            total([r.forces for r in solutions], whole),
            total([r.load for r in solutions], retained),
            total([r.prescribed_load for r in solutions], retained),
        )
