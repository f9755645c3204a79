"""Dimensionless equations of a system, and their matrices, for the solution methods.

Displacements are divided by the size of the mesh, stiffness by the largest diagonal entry of the
bulk, so that the iterations do not depend on the units.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from petsc4py import PETSc

from fenics_contact.contact.values import Status
from fenics_contact.methods.active_set_monitor import ActiveSetMonitor
from fenics_contact.methods.limit_analysis import Overload, find_overloads
from fenics_contact.methods.regularisation import UnconstrainedModes
from fenics_contact.parallel import global_max, global_sum
from fenics_contact.systems.balance import InitialForces, Norms
from fenics_contact.systems.ejected_bodies import find_ejected_bodies
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.hierarchy import Hierarchy
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.systems.system import System
from fenics_contact.tolerances import NEGLIGIBLE, ROUND_OFF, UNLOADED_FORCE_RATIO
from fenics_contact.types import Array

__all__ = ["Equations"]


# Stiffness of open relative to closed points in H₀: constrains a body whose contact is open.
_OPEN_STIFFNESS_RATIO = 1e-3
# Least regularisation of a mode, which may have no unbalanced force.
_MIN_REGULARISATION_RATIO = 1e-6


class Equations:
    """Residual, energy and matrices at the states of a method.

    Args:
        alpha: Fraction of the normal stiffness in H₀.
        phi: Fraction of the tangential stiffness of sticking points in H₀.

    Attributes:
        full: The system on all unknowns.
        system: The system that is solved, `full` or a condensed one.
        contacts: The contacts.
        motions: Rigid-body modes of the bodies.
        length: Reference length of the displacements.
        monitor: Monitor of the active set.
        norms: Norms of the last `residual`.
        start: Forces at the beginning of the increment.
        initial_unknowns: State of `full` at the beginning of the increment.
        is_round_off_known: Whether the round-off of residuals is known, from an assembled matrix.
        rtol: Residual by the forces at which the solution has converged.
        augmentation_rtol: Tolerance of the solution before the next augmentation, if larger.
        solution: Dimensionless initial guess and, after a method, solution.
        function: Vector for the residual.
        solvers: Linear solvers for H₀ (False) and the consistent tangent (True).
        valid_matrices: Which of their matrices are assembled for a present state.
        has_solution_tangent: Whether the factored consistent tangent is that of a solution.
        is_h0_current: Whether H₀ is that of `assemble_h0` or of a later status; if False, it is
            assembled before its next use.
        uses_v_cycle: Whether H₀ is a multigrid V-cycle, with one matrix for H₀ and the tangent.
        hierarchy: Its levels.
        factorisations: Number of sparse factorisations.
        generalised_loads: Largest generalised load on rigid-body modes, (n_groups,) (force).
        regularised_modes: Modes along which the last consistent tangent is regularised,
            (n_modes, n_motions).
        overload: Overload of friction found by a method.
    """

    def __init__(
        self, full: FullSystem, motions: RigidBodyModes, *, alpha: float, phi: float
    ) -> None:
        self.full, self.motions, self.contacts = full, motions, full.contacts
        self.length = full.scales.mesh_size
        self._bulk, self._comm = full.bulk, full.unknowns.comm
        self._alpha, self._phi = alpha, phi
        self.monitor = ActiveSetMonitor(full.contacts)
        zeros: Array = np.zeros(full.n_bodies)
        self.norms = Norms(zeros, zeros, zeros, zeros, zeros.size)
        self.initial_forces = InitialForces(zeros, np.zeros((len(full.contacts), full.n_bodies)))
        self.rtol = self.augmentation_rtol = 0.0
        self.solvers: dict[bool, PETSc.KSP] = {}
        self.uses_v_cycle, self.hierarchy = False, Hierarchy()
        self.factorisations = 0
        self.generalised_loads: Array = np.zeros(full.scales.n_groups)
        self.regularised_modes: Array = np.zeros((0, 0))
        self.overload: Overload | None = None
        self._matrices: dict[bool, PETSc.Mat] = {}
        self.valid_matrices: set[bool] = set()
        self.is_h0_current = self.has_solution_tangent = False
        self.system: System = full
        self.initial_unknowns = full.state()
        self.is_round_off_known = False
        self.solution, self.function = full.vector(), full.vector()

    def set_system(self, system: System) -> None:
        """Set the system to solve. Collective."""
        self.system = system
        self.solution, self.function = system.vector(), system.vector()

    # ---- at a state ------------------------------------------------------------------------------

    def set_state(self, x: PETSc.Vec) -> None:
        """Set a dimensionless state, except for prescribed values. Collective."""
        state = x.array_r * self.length
        # A V-cycle also changes prescribed unknowns.
        state[self.system.constrained] = self.system.prescribed
        self.system.set_state(state)

    def residual(self, x: PETSc.Vec, f: PETSc.Vec) -> Norms:
        """Compute the residual at ``x`` into ``f``, and its norms. Collective.

        The residual is NaN if cells are inverted, obstacles have rotated too far, Γc has no tangent
        plane, or bodies are ejected.
        """
        self.set_state(x)
        contacts = self.system.contact_forces()
        total = sum(contacts, self.system.bulk_force())
        system = self.system
        # No force acts on an ejected body: Newton's method would converge there.
        ejected = system is self.full and find_ejected_bodies(
            self.full, self.motions, contacts, self.initial_unknowns, self.initial_forces
        )
        if (
            ejected
            or self._bulk.is_inverted()
            or system.is_over_rotated()
            or system.is_degenerate()
        ):
            total[:] = np.nan  # a line search takes a shorter step
        self.norms = self.system.norms(total, contacts, self.initial_forces)
        # The line search must not follow the round-off of a stiff body. After a restart it is
        # unknown until a matrix is assembled.
        left_out = self.norms.is_round_off & self.is_round_off_known
        self.norms = self.norms.exclude(left_out)
        total[self.system.constrained | left_out[self.system.partition.label]] = 0.0
        f.array[:] = total / (self._bulk.scale * self.length)
        return self.norms

    def residual_at(self, state: Array) -> float:
        """Compute the residual at a state of the system in ``function``; its norm. Collective."""
        self.solution.array[:] = state / self.length
        return self.residual(self.solution, self.function).total

    def energy(self, x: PETSc.Vec) -> float:
        """Compute the dimensionless potential of linear bulk and contacts at ``x``. Collective."""
        self.set_state(x)
        energy = self.system.bulk_energy() + sum(c.energy() for c in self.contacts)
        total = float(global_sum(self._comm, energy))
        return total / (self._bulk.scale * self.length**2)

    def energy_size(self) -> float:
        """Sum the absolute values of the terms of `energy` at the present state. Collective."""
        state = self.system.state()
        size = float(np.abs(self.system.roundoff_magnitude(state) * state).sum())
        size += float(np.abs(self.system.load * state).sum())
        total = float(global_sum(self._comm, size + sum(abs(c.energy()) for c in self.contacts)))
        return total / (self._bulk.scale * self.length**2)

    def is_converged(self, rtol: float = 0.0) -> bool:
        """Return whether the last residual is within the present tolerance, or ``rtol``."""
        return self.norms.is_within(max(self.rtol, self.augmentation_rtol, rtol))

    def find_overloads(self) -> list[Overload]:
        """Find overloads of friction at the last pressures, for a linear bulk. Collective."""
        if not self._bulk.linear:  # a deformation may change loads and constraints of other bodies
            return []
        return find_overloads(self.motions, self.full.operators, self.full.load)

    # ---- matrices --------------------------------------------------------------------------------

    @property
    def has_potential(self) -> bool:
        """Whether every contact law has a potential."""
        return all(c.effective_law.has_potential for c in self.contacts)

    def is_symmetric(self, consistent: bool) -> bool:
        """Return whether the matrix of H₀, or of the consistent tangent, is symmetric."""
        return self._bulk.symmetric and (not consistent or self.has_potential)

    def matrix(self, consistent: bool) -> PETSc.Mat:
        """Return the matrix of H₀ or of the consistent tangent, created on demand. Collective."""
        if consistent not in self._matrices:
            symmetric = self.is_symmetric(consistent or self.uses_v_cycle)
            matrix = self.system.matrix(symmetric=symmetric)
            self.system.prepare(self.solvers[consistent], matrix)
            self._matrices[consistent] = matrix
        return self._matrices[consistent]

    def forget_matrices(self) -> None:
        """Delete the matrices of H₀ and of the consistent tangent. Collective."""
        self._matrices, self.valid_matrices, self.hierarchy = {}, set(), Hierarchy()
        for ksp in self.solvers.values():
            ksp.reset()
        self.is_h0_current = self.has_solution_tangent = False

    def assemble_h0(self, *, everywhere: bool) -> None:
        """Assemble the symmetric H₀ = K + αK_n + φK_t (section 5), by `stiffnesses`. Collective."""
        self.assemble(self.matrix(False), self.stiffnesses(everywhere=everywhere))
        self.is_h0_current = True

    def assemble(self, matrix: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> None:
        """Assemble bulk tangent and contacts, whose matrices are destroyed. Collective."""
        filled = {c for c, m in self._matrices.items() if m.handle == matrix.handle}
        if True in filled:  # reset before the generator ``contacts`` may set them
            self.regularised_modes = np.zeros((0, 0))
            self.has_solution_tangent = False
        self.factorisations += self.system.fill(matrix, contacts)
        self.is_round_off_known = True
        if self.system.pattern_changes:
            # Neither a factorisation nor multigrid levels can be reused for another pattern.
            self.hierarchy = Hierarchy()
            for consistent in filled:
                self.solvers[consistent].reset()
                self.solvers[consistent].setOperators(matrix)
        self.valid_matrices |= filled
        if self.uses_v_cycle and False in filled:
            stiffness, operators = self.full.stiffness, self.full.operators
            assert stiffness is not None
            self.hierarchy.follow(self.solvers[False], matrix, stiffness, operators)

    def assemble_tangent(self, x: PETSc.Vec, matrix: PETSc.Mat, *, trial: bool = False) -> None:
        """Assemble the consistent tangent at ``x``; ``trial`` as in `evaluate`. Collective."""
        self.evaluate(x, trial=trial)
        self.assemble(matrix, self.regularised_tangents())

    def evaluate(self, x: PETSc.Vec, *, trial: bool = False) -> None:
        """Evaluate bulk and contacts at ``x``, the point of the last residual. Collective.

        The monitor records iterates, but no ``trial`` points.
        """
        self.set_state(x)
        if not self._bulk.linear:
            self.full.update_stiffness()
        self.full.evaluate()
        if not trial:
            self.record_iterate()

    def record_iterate(self) -> None:
        """Record residual and status of the evaluated iterate in the monitor."""
        self.monitor.record(self.norms.total)

    def is_constrained(self) -> bool:
        """Return whether the closed points constrain all rigid-body modes. Collective."""
        return self.motions.is_constrained(self.full.operators)

    def regularised_tangents(self) -> Iterator[PETSc.Mat]:
        """Yield consistent tangents, regularised along unconstrained modes. Collective.

        Slipping points of the bodies get the secant stiffness of friction, weighted by the largest
        unbalanced fraction of the forces on a mode of their chain of bodies: a step along the mode
        is as long as the slip. A loose body does not regularise others that it does not touch.
        Where slipping points would not constrain the body if they stuck, open points get the
        stiffness with which a step closes the nearest gap (`UnconstrainedModes.closing_stiffness`).
        Open points with a friction bound independent of the pressure slip. The regularisation
        vanishes with the residual: convergence remains superlinear (Levenberg-Marquardt).
        """
        full, modes = self.full, self._find_unconstrained_modes()
        if modes is None:
            self.regularised_modes = np.zeros((0, 0))
            yield from self.tangents()
            return
        free = ~np.isnan(modes.imbalance)
        self.regularised_modes = modes.vectors @ self.motions.free
        imbalance = np.where(free, np.maximum(modes.imbalance, _MIN_REGULARISATION_RATIO), 0.0)
        operators = self.system.operators
        within = [operator.within for operator in operators]
        stiffness = modes.closing_stiffness(self.motions, full.scales, full.operators, within)
        for number, (operator, closing) in enumerate(zip(operators, stiffness, strict=True)):
            contact, chain = operator.contact, modes.at_points[number]
            values, closed = contact.values, contact.status != Status.OPEN
            slip_ratio = np.where(values.is_slipping, imbalance[chain], 0.0)
            open_ratio = np.where(closing < 1.0, closing, imbalance[chain])
            open_ratio[closed | ~modes.is_open[chain]] = 0.0
            tangent = contact.effective_law.tangent().scale(1.0 - slip_ratio)
            yield operator.tangent(tangent)
            normal = open_ratio + np.where(closed, slip_ratio, 0.0)
            tangential = np.where(values.friction_bound > 0, 0.0, open_ratio)
            tangential += slip_ratio * values.friction_secant
            yield operator.springs(values.springs(normal, tangential))

    def _find_unconstrained_modes(self) -> UnconstrainedModes | None:
        """Find the modes that contact leaves unconstrained at the evaluated state. Collective."""
        full, motions = self.full, self.motions
        if not len(motions.free):
            return None
        # Round-off closes some of many points of an initially positioned body.
        unloaded = full.contact_force_sizes() < UNLOADED_FORCE_RATIO * self.generalised_loads
        initial = self.monitor.initial_tractions or [c.values.total_traction for c in self.contacts]
        return UnconstrainedModes.find(
            motions, full.scales, full.operators, full.load, initial, unloaded
        )

    def tangents(self) -> Iterator[PETSc.Mat]:
        """Yield the consistent tangents of the evaluated contacts. Collective."""
        return (operator.tangent() for operator in self.system.operators)

    def stiffnesses(self, *, everywhere: bool) -> Iterator[PETSc.Mat]:
        """Yield αK_n + φK_t of the evaluated contacts; ``everywhere``: all of Γc sticks.

        Of contacts without history, open points whose gap is zero stick: the bodies touch at rest,
        and resist the first load.
        """
        for number, operator in enumerate(self.system.operators):
            contact = operator.contact
            normal = tangential = np.ones(contact.quadrature.n_points)
            if not everywhere:
                status, size = contact.status, self.full.scales.size_at_points(number)
                touches = np.abs(contact.gap) <= NEGLIGIBLE * size
                touches &= contact.states.committed.points is None
                ratio = np.where(touches, 1.0, _OPEN_STIFFNESS_RATIO)
                normal = np.where(status != Status.OPEN, 1.0, ratio)
                tangential = np.where(status == Status.STICK, 1.0, ratio)
            springs = contact.values.springs(self._alpha * normal, self._phi * tangential)
            yield operator.springs(springs)

    def stiffness_ratio(self) -> float:
        """Return the largest ratio of contact to bulk stiffness at an unknown. Collective."""
        bulk = self.system.bulk_diagonal()
        added = np.zeros_like(bulk)
        for operator in self.system.operators:
            part = operator.springs(operator.contact.values.springs(1.0, 1.0))
            diagonal = part.getDiagonal()
            added += diagonal.array_r
            part.destroy()
            diagonal.destroy()
        # The rigid motion of an obstacle has no bulk stiffness.
        stiffness = np.append(self.full.scales.stiffness, np.full(self.system.n_bodies, np.inf))
        of_body = stiffness[self.system.partition.label]
        has_stiffness = (bulk > ROUND_OFF * of_body) & ~self.system.constrained
        return global_max(self._comm, added[has_stiffness] / bulk[has_stiffness])
