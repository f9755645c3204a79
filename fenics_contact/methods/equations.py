"""What a method sees of a problem: dimensionless equations over a system, and their matrices.

Displacements are by the size of the mesh, stiffness by the largest entry of the bulk's diagonal, so
that the same scene takes the same iterations in any units.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from petsc4py import PETSc

from fenics_contact.contact.values import Status
from fenics_contact.methods.active_set_monitor import ActiveSetMonitor
from fenics_contact.methods.limit_analysis import Overload, find_overload
from fenics_contact.methods.regularisation import UnconstrainedModes
from fenics_contact.parallel import global_max, global_sum
from fenics_contact.systems.balance import InitialForces, Norms
from fenics_contact.systems.ejected_bodies import find_ejected_bodies
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.hierarchy import Hierarchy
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.systems.system import System
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array

__all__ = ["Equations"]


# An open point keeps this share of its stiffness in H₀: enough that a body held by contact alone
# stays held when its whole surface is open, too little to be felt as a wrong tangent.
_OPEN_SHARE = 1e-3
# The least share with which a tangent is regularised: on a mode without any force nothing is left.
_LEAST_SHARE = 1e-6


class Equations:
    """Residual, energy and matrices at a state that a method asks for.

    Args:
        alpha: Share of the normal stiffness in H₀.
        phi: Share of the tangential stiffness of sticking points in H₀.

    Attributes:
        full: The system on all unknowns.
        system: The one that is iterated on, `full` or one condensed.
        contacts: The contacts.
        motions: Rigid motions of the bodies.
        length: What displacements are divided by.
        watch: What becomes of the status of the points from iteration to iteration.
        norms: Norms where `residual` was computed last.
        start: Forces at the beginning of the increment.
        began: State of `full` there.
        has_round_off: Whether a matrix was assembled in this increment, which tells the round-off
            of its residuals.
        rtol: Residual that ends the whole solution, as a share of the forces.
        augmentation_rtol: That of the present round of multipliers, if larger.
        solution: The state to start from and, after a method, the one found; dimensionless.
        function: For the residual.
        solvers: Linear solvers for H₀ (False) and the consistent tangent (True).
        filled: Which of their matrices hold anything, and not that of another state.
        h0_is_made: Whether that of H₀ is what `make_h0` made, or made of the status since; False
            lets it be made before its next use.
        by_cycle: Whether H₀ is a V-cycle, which serves for its matrix as for the tangent.
        hierarchy: Its levels.
        factorisations: Of sparse matrices, counted.
        loads: The largest generalised force of the load on rigid-body modes, (n_groups,) (force).
        regularised_modes: Rigid-body modes along which the consistent tangent assembled last is
            regularised, in all motions, (n_modes, n_motions).
        overload: By what the load outdoes friction, where a method has found that it does.
    """

    def __init__(
        self, full: FullSystem, motions: RigidBodyModes, *, alpha: float, phi: float
    ) -> None:
        self.full, self.motions, self.contacts = full, motions, full.contacts
        self.length = full.scales.mesh_size
        self._bulk, self._comm = full.bulk, full.unknowns.comm
        self._alpha, self._phi = alpha, phi
        self.monitor = ActiveSetMonitor(full.contacts)
        nothing: Array = np.zeros(full.n_bodies)
        self.norms = Norms(nothing, nothing, nothing, nothing, nothing.size)
        self.start = InitialForces(nothing, np.zeros((len(full.contacts), full.n_bodies)))
        self.rtol = self.augmentation_rtol = 0.0
        self.solvers: dict[bool, PETSc.KSP] = {}
        self.by_cycle, self.hierarchy = False, Hierarchy()
        self.factorisations = 0
        self.loads: Array = np.zeros(full.scales.n_groups)
        self.regularised_modes: Array = np.zeros((0, 0))
        self.overload: Overload | None = None
        self._matrices: dict[bool, PETSc.Mat] = {}
        self.filled: set[bool] = set()
        self.h0_is_made = False
        self.system: System = full
        self.initial_unknowns = full.state()
        self.has_round_off = False
        self.solution, self.function = full.vector(), full.vector()

    def take(self, system: System) -> None:
        """Iterate on a system from now on. Collective."""
        self.system = system
        self.solution, self.function = system.vector(), system.vector()

    # ---- at a state ------------------------------------------------------------------------------

    def set_state(self, x: PETSc.Vec) -> None:
        """Make a dimensionless state the present one, prescribed values apart. Collective."""
        state = x.array_r * self.length
        # A V-cycle moves the prescribed unknowns too, which nothing would bring back.
        state[self.system.constrained] = self.system.prescribed
        self.system.set_state(state)

    def residual(self, x: PETSc.Vec, f: PETSc.Vec) -> Norms:
        """Compute the residual at ``x`` into ``f``, and its norms, kept too. Collective.

        It is not a number where cells are turned inside out, obstacles have turned too far, Γc has
        no tangent plane, or bodies are ejected.
        """
        self.set_state(x)
        contacts = self.system.contact_forces()
        total = sum(contacts, self.system.bulk_force())
        system = self.system
        # Newton's method would end there: nothing acts on such a body.
        ejected = system is self.full and find_ejected_bodies(
            self.full, self.motions, contacts, self.initial_unknowns, self.start
        )
        if ejected or self._bulk.is_inverted() or system.is_twisted() or system.is_degenerate():
            total[:] = np.nan  # a line search takes a shorter step
        self.norms = self.system.norms(total, contacts, self.start)
        # No line search is to follow the round-off of a stiff body beside what is left on others.
        # It is known once a matrix was assembled: before, a run taken up again has none.
        left_out = self.norms.is_round_off & self.has_round_off
        self.norms = self.norms.without(left_out)
        total[self.system.constrained | left_out[self.system.label]] = 0.0
        f.array[:] = total / (self._bulk.scale * self.length)
        return self.norms

    def residual_at(self, state: Array) -> float:
        """Norm of the residual at a state of the system, left in ``function``. Collective."""
        self.solution.array[:] = state / self.length
        return self.residual(self.solution, self.function).total

    def energy(self, x: PETSc.Vec) -> float:
        """Potential of a linear bulk and contacts at ``x``. Collective."""
        self.set_state(x)
        energy = self.system.bulk_energy() + sum(c.energy() for c in self.contacts)
        total = float(global_sum(self._comm, energy))
        return total / (self._bulk.scale * self.length**2)

    def energy_size(self) -> float:
        """Size of the terms that `energy` sums up at the present state. Collective."""
        state = self.system.state()
        size = float(np.abs(self.system.terms(state) * state).sum())
        size += float(np.abs(self.system.load * state).sum())
        total = float(global_sum(self._comm, size + sum(abs(c.energy()) for c in self.contacts)))
        return total / (self._bulk.scale * self.length**2)

    def solved(self, rtol: float = 0.0) -> bool:
        """Whether the residual computed last ends the present round, or is below ``rtol``."""
        return self.norms.within(max(self.rtol, self.augmentation_rtol, rtol))

    def find_overload(self) -> Overload | None:
        """See `find_overload`, by the pressures evaluated last; of linear bodies. Collective."""
        if not self._bulk.linear:  # a deformation may turn the loads on another, and what holds it
            return None
        return find_overload(self.motions, self.full.operators, self.full.load)

    # ---- matrices --------------------------------------------------------------------------------

    @property
    def has_potential(self) -> bool:
        """Whether every contact law has one."""
        return all(c.effective_law.has_potential for c in self.contacts)

    def symmetric(self, consistent: bool) -> bool:
        """Whether the matrix of H₀, or of the consistent tangent, is."""
        return self._bulk.symmetric and (not consistent or self.has_potential)

    def matrix(self, consistent: bool) -> PETSc.Mat:
        """The matrix of H₀ or of the consistent tangent, made when first needed. Collective."""
        if consistent not in self._matrices:
            symmetric = self.symmetric(consistent or self.by_cycle)
            matrix = self.system.matrix(symmetric=symmetric)
            self.system.prepare(self.solvers[consistent], matrix)
            self._matrices[consistent] = matrix
        return self._matrices[consistent]

    def forget_matrices(self) -> None:
        """Drop the matrices of H₀ and of the consistent tangent. Collective."""
        self._matrices, self.filled, self.hierarchy = {}, set(), Hierarchy()
        for ksp in self.solvers.values():
            ksp.reset()
        self.h0_is_made = False

    def make_h0(self, *, everywhere: bool) -> None:
        """K + αK_n + φK_t of a symmetric H₀ (section 5); see `stiffnesses`. Collective."""
        self.assemble(self.matrix(False), self.stiffnesses(everywhere=everywhere))
        self.h0_is_made = True

    def assemble(self, matrix: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> None:
        """Bulk tangent plus contact, conditions applied, dimensionless. Collective.

        Args:
            matrix: What to fill.
            contacts: Contact's part, used up.
        """
        filled = {c for c, m in self._matrices.items() if m.handle == matrix.handle}
        if True in filled:  # unless ``contacts``, made while the matrix is filled, are regularised
            self.regularised_modes = np.zeros((0, 0))
        self.factorisations += self.system.fill(matrix, contacts)
        self.has_round_off = True
        if self.system.pattern_changes:
            # A factorisation of another pattern is no start, whatever the matrix says, and levels
            # do not follow: there may be other unknowns in contact, too.
            self.hierarchy = Hierarchy()
            for consistent in filled:
                self.solvers[consistent].reset()
                self.solvers[consistent].setOperators(matrix)
        self.filled |= filled
        if self.by_cycle and False in filled:
            stiffness, operators = self.full.stiffness, self.full.operators
            assert stiffness is not None
            self.hierarchy.follow(self.solvers[False], matrix, stiffness, operators)

    def assemble_tangent(self, x: PETSc.Vec, matrix: PETSc.Mat, *, trial: bool = False) -> None:
        """The consistent tangent of bulk and contact at ``x``; see `evaluate`. Collective."""
        self.evaluate(x, trial=trial)
        self.assemble(matrix, self.regularised_tangents())

    def evaluate(self, x: PETSc.Vec, *, trial: bool = False) -> None:
        """Evaluate bulk and contacts at ``x``, where the residual was computed last. Collective.

        Args:
            x: Where.
            trial: Whether that is no iterate: then `watch` does not see it.
        """
        self.set_state(x)
        if not self._bulk.linear:  # else nothing changes it during a solution
            self.full.update_stiffness()
        self.full.evaluate()
        if not trial:
            self.note()

    def note(self) -> None:
        """Let `watch` see the status of the points, evaluated where `norms` are from."""
        self.monitor.record(self.norms.total)

    def is_constrained(self) -> bool:
        """Whether the closed points hold all free motions. Collective."""
        return self.motions.is_constrained(self.full.operators)

    def regularised_tangents(self) -> Iterator[PETSc.Mat]:
        """`tangents`, regularised where contact leaves a rigid-body mode free. Collective.

        Slipping points of the bodies concerned get the secant stiffness of friction under the
        present pressure, with which a step along the mode goes as far as they have slipped, by the
        share of the forces on the mode that is not in balance. Open points get the stiffness with
        which it closes the nearest gap (`UnconstrainedModes.closing`), where slipping points would
        not hold the body if they stuck. Open points at which friction acts all the same (a bound
        that does not depend on the pressure) count as slipping points along Γc. With the residual
        the regularisation vanishes, and convergence stays superlinear (Levenberg-Marquardt).
        """
        full, modes = self.full, self._unconstrained_modes()
        if modes is None or np.isnan(modes.share).all():
            self.regularised_modes = np.zeros((0, 0))
            yield from self.tangents()
            return
        free = ~np.isnan(modes.share)
        self.regularised_modes = modes.ways @ self.motions.free
        share = np.where(free, np.maximum(modes.share, _LEAST_SHARE), 0.0)
        operators = self.system.operators
        within = [operator.within for operator in operators]
        closing = modes.closing(self.motions, full.scales, full.operators, within)
        for number, (operator, close) in enumerate(zip(operators, closing, strict=True)):
            contact, group = operator.contact, full.scales.group_of_points(number)
            values, closed = contact.values, contact.status != Status.OPEN
            slips = np.where(values.slips, share[group], 0.0)
            opens = np.where(close < 1.0, close, share[group])
            opens[closed | ~modes.is_open[group]] = 0.0
            tangent = contact.effective_law.tangent().scaled(1.0 - slips)
            yield operator.tangent(tangent)
            normal = opens + np.where(closed, slips, 0.0)
            tangential = np.where(values.friction_bound > 0, 0.0, opens)
            tangential += slips * values.friction_secant
            yield operator.springs(values.springs(normal, tangential))

    def _unconstrained_modes(self) -> UnconstrainedModes | None:
        """Rigid-body modes that contact leaves free at the evaluated state. Collective."""
        full, motions = self.full, self.motions
        if not len(motions.free):
            return None
        # Of a body that was positioned round-off closes some of many points.
        idle = full.contact_force_sizes() < _OPEN_SHARE * self.loads
        first = self.monitor.initial_tractions or [c.values.total_traction for c in self.contacts]
        return UnconstrainedModes.find(motions, full.scales, full.operators, full.load, first, idle)

    def tangents(self) -> Iterator[PETSc.Mat]:
        """Consistent tangents of the contacts, which are evaluated. Collective."""
        return (operator.tangent() for operator in self.system.operators)

    def stiffnesses(self, *, everywhere: bool) -> Iterator[PETSc.Mat]:
        """The shares αK_n + φK_t of the contacts, as evaluated.

        Args:
            everywhere: Take all of Γc as closed and sticking, as the paper does, where nothing
                can be told from the status.
        """
        for operator in self.system.operators:
            contact = operator.contact
            normal = tangential = np.ones(contact.quadrature.n_points)
            if not everywhere:
                normal = np.where(contact.status != Status.OPEN, 1.0, _OPEN_SHARE)
                tangential = np.where(contact.status == Status.STICK, 1.0, _OPEN_SHARE)
            springs = contact.values.springs(self._alpha * normal, self._phi * tangential)
            yield operator.springs(springs)

    def stiffness_ratio(self) -> float:
        """Largest ratio of contact's stiffness to the bulk's at an unknown. Collective."""
        bulk = self.system.bulk_diagonal()
        added = np.zeros_like(bulk)
        for operator in self.system.operators:
            part = operator.springs(operator.contact.values.springs(1.0, 1.0))
            diagonal = part.getDiagonal()
            added += diagonal.array_r
            part.destroy()
            diagonal.destroy()
        # The motion of an obstacle has no stiffness.
        stiffness = np.append(self.full.scales.stiffness, np.full(self.system.n_bodies, np.inf))
        felt = (bulk > ROUND_OFF * stiffness[self.system.label]) & ~self.system.constrained
        return global_max(self._comm, added[felt] / bulk[felt])
