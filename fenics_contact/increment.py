"""Solution and verification of one increment from a committed state."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from fenics_contact.checks.energy import Energy, EnergyState
from fenics_contact.checks.input_validation import check_prescribed_values
from fenics_contact.checks.verdict import Verdict
from fenics_contact.checks.verifier import Verifier
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.states import ContactTrial
from fenics_contact.failure import NotConverged
from fenics_contact.methods.attempt import Attempt
from fenics_contact.methods.first_touch import set_slip_reference_at_touch
from fenics_contact.methods.initial_positioning import InitialPositioning
from fenics_contact.methods.load_balance import check_balance, find_free_modes
from fenics_contact.methods.pair_iteration import PairIteration
from fenics_contact.methods.solver import Solver
from fenics_contact.methods.unloaded_bodies import move_unloaded_bodies
from fenics_contact.parallel import global_max
from fenics_contact.state import State, Trial
from fenics_contact.step import Step
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.modulus_tracking import TrackedModulus
from fenics_contact.systems.partition import Partition
from fenics_contact.systems.system import System
from fenics_contact.types import Array

__all__ = ["Increment", "IncrementSolver", "Retry"]


class Retry(Enum):
    """Reason to solve an increment again, and the outcome reported of its last attempt."""

    UNKNOWNS = "contact spreads beyond the retained dofs"
    PAIRS = "converged; opposite points updated, solved again"
    FROM_COMMITTED = "failed between predicted opposite points, solved again between committed ones"


@dataclass
class Increment:
    """An increment that is being solved.

    Attributes:
        recover_interior: Whether the interior displacement is recovered after static condensation.
        points: The iteration for the opposite points.
        start_time: Start of the solution, by `time.perf_counter` (s).
        attempts: All attempts in their order.
    """

    recover_interior: bool
    points: PairIteration
    start_time: float = field(default_factory=time.perf_counter)
    attempts: list[Attempt] = field(default_factory=list)

    def set_outcome(self, outcome: Retry) -> Retry:
        """Set the outcome of the last attempt and return it."""
        self.attempts[-1] = replace(self.attempts[-1], outcome=outcome.value)
        return outcome


@dataclass(frozen=True)
class IncrementSolver:
    """Solves increments of a problem. It changes u and the contacts, but no `State`.

    Attributes:
        full: The system on all unknowns.
        solver: Solver of the nonlinear equations.
        verifier: Verifies a solution.
        modulus: Young's modulus at Γc, updated with the data of the bulk.
        prefix: Prefix of the PETSc options, for messages.
    """

    full: FullSystem
    solver: Solver
    verifier: Verifier
    modulus: TrackedModulus
    prefix: str

    # ---- input -----------------------------------------------------------------------------------

    def _check_input(self, *, balance: bool) -> Array:
        """Check the data of the increment, and return its external forces (force). Collective.

        With ``balance``, a load that contact cannot balance is a ValueError.
        """
        self.full.bulk.check_finite()
        for contact in self.full.contacts:
            contact.check_input()
        load = self.full.present_load()
        size = global_max(self.full.unknowns.comm, np.abs(load))
        if not np.isfinite(size):
            raise ValueError(
                "the external load, F at u = 0, is not finite (NaN or inf) at some dof: check the "
                "loads, and the denominators in F (λ = E ν/((1 + ν)(1 - 2ν)) is infinite at "
                "ν = 0.5)"
            )
        check_prescribed_values(self.full.bcs, self.full.displacement.whole)
        if self.full.bulk.has_new_data():
            find_free_modes(self.solver.equations.motions, self.full)
        if balance and self.full.bulk.linear:
            check_balance(self.solver.equations.motions, load, self.full.operators)
        return load

    # ---- solving ---------------------------------------------------------------------------------

    def attempt(
        self, increment: Increment, state: State, present: State | Trial
    ) -> tuple[Trial, Step] | Retry:
        """Solve an increment with its present pairs, on the retained dofs. Collective.

        ``present`` is the state of the present u.

        Returns:
            The trial state and its `Step`; or the reason to solve the increment again.

        Raises:
            NotConverged: No solution was found, or it failed the verification.
            ValueError: Invalid input, or no contact force can balance the load.
        """
        solver, points = self.solver, increment.points
        # With replaced pairs, a load without balance is a failure of the increment, not of input.
        load = self._check_input(balance=not points.replaced)
        complete = present.interior is None and state.interior is None
        if complete and points.contacts and not (increment.attempts or points.replaced):
            self._predict_opposite_points(points, state, load)
        before = self.full.state()
        self.full.prescribe()
        solver.predictor.store_prescribed_change(before)
        stiffness_changed = self.full.update_stiffness()
        if stiffness_changed and self.full.bulk.linear:
            self.modulus.measure()
        positioning = InitialPositioning(self.full, solver.equations.motions, load, before)
        was_unloaded = positioning.position_bodies(first=state.increment == 0)
        if solver.select_dofs():
            return Retry.UNKNOWNS
        solver.update_system(stiffness_changed)
        self.full.scales.begin(self.full.operators)
        solver.system.begin(load)
        solver.equations.initial_unknowns = state.unknowns
        positioned = np.where(self.full.constrained, before, self.full.state())
        end = set_slip_reference_at_touch(solver.equations, positioned)
        solver.predictor.change = state.change
        solver.predictor.expected = end if points.end is None else points.end
        with solver.system.restricted_contacts():
            reason, attempts, augmentations = solver.solve(
                was_unloaded=was_unloaded,
                stiffness_changed=stiffness_changed,
                load_before=state.load,
                balance=not points.replaced,
                fallback=not points.predicted,
            )
        # Points outside of the retained dofs can only be verified with the interior displacement.
        skips_recovery = not (increment.recover_interior or solver.system.is_restricted)
        skips_recovery = skips_recovery and self._can_skip_recovery(state)
        interior = solver.system.pending_field if skips_recovery else None
        if not skips_recovery:
            solver.system.complete(solver.system.pending_field)
        self.full.evaluate()
        part = solver.system.restrict if skips_recovery else np.asarray
        if (
            reason > 0
            and move_unloaded_bodies(solver.equations, part)
            and solver.equations.has_solution_tangent
        ):
            solver.predictor.store_converged_contacts()
        increment.attempts += attempts
        if reason <= 0 and points.drop_prediction():
            return increment.set_outcome(Retry.FROM_COMMITTED)
        if solver.needs_more_dofs(found=reason > 0):
            return increment.set_outcome(Retry.UNKNOWNS)
        if reason > 0 and (outdated := points.find_outdated()):
            return self._choose_pairs(increment, outdated, interior)
        kinematics = reason > 0  # after a failure there may be no factors
        if skips_recovery:
            verdict, energies = self._verify_retained(state.unknowns, kinematics=kinematics)
        else:
            assemble = increment.recover_interior or not solver.system.is_restricted
            verdict, energies = self._verify_all(
                state.unknowns, kinematics=kinematics, assemble=assemble
            )
        if reason > 0 and (outdated := points.find_outdated_for(verdict.pairing_errors)):
            return self._choose_pairs(increment, outdated, interior)
        energy = None
        if reason > 0 and not verdict.failures:
            energy = self._compute_energy(state, energies, points)
            verdict = replace(verdict, friction_energy_gain=energy.friction_energy_gain)
        if energy is None or verdict.failures:
            if points.drop_prediction():
                return increment.set_outcome(Retry.FROM_COMMITTED)
            raise self._not_converged(state, reason, verdict, increment.attempts)
        self.verifier.warn_of_large_motion(verdict)
        self.verifier.warn_of_round_off(verdict)
        self.verifier.warn_of_few_points()
        trials = (
            c.states.trial(is_loaded=verdict.equations[c.name].is_loaded)
            for c in self.full.contacts
        )
        trial = Trial(self.full.state(), tuple(trials), load, energies, interior)
        step = Step(
            increment=state.increment + 1,
            reason=reason,
            iterations=sum(attempt.iterations for attempt in increment.attempts),
            augmentations=augmentations,
            method=increment.attempts[-1].method,
            factorisations=solver.equations.factorisations,
            verdict=verdict,
            contacts={c.name: c.resultants() for c in self.full.contacts},
            energy=energy,
            attempts=tuple(increment.attempts),
            wall_seconds=time.perf_counter() - increment.start_time,
            complete=not skips_recovery,
        )
        return trial, step

    def _predict_opposite_points(self, points: PairIteration, state: State, load: Array) -> None:
        """Find opposite points at the extrapolated end of the increment. Collective."""
        before = self.full.state()
        points.predict(state, self.full.prescribed_values(), load)
        points.begin(self.full.contacts)
        self.full.set_state(before)
        for contact in self.full.contacts:
            contact.states.forget()

    def _choose_pairs(
        self, increment: Increment, contacts: Sequence[Contact], interior: Array | None
    ) -> Retry:
        """Choose the states in which contacts find new pairs, with a complete u. Collective."""
        if interior is not None:
            self.solver.system.complete(interior)
        increment.points.relax_states(contacts, self.full.state())
        return increment.set_outcome(Retry.PAIRS)

    def _can_skip_recovery(self, state: State) -> bool:
        """Whether energies and pairs do not depend on the interior displacement. Collective."""
        contacts, comm = self.full.contacts, self.full.unknowns.comm
        if not (self.solver.condensed and self.full.bulk.symmetric):
            return False
        for contact in contacts:
            # Pairs of a body without any are searched at its complete displacement.
            unpaired = contact.contact_kinematics.can_update_pairs and not comm.allreduce(
                int(contact.pairs.paired.any())
            )
            if unpaired or contact.contact_kinematics.updates_pairs:
                return False
        # The positions of nodes that the quadrature points do not determine need a complete u.
        if not all(
            c.contact_kinematics.sampler is None or c.facet_sampling.points_determine_nodes
            for c in contacts
        ):
            return False
        if self.solver.system.coordinate_id in state.energy.forces:
            return True
        return state.increment == 0 and not comm.allreduce(int(state.unknowns.any()))

    def _not_converged(
        self, state: State, reason: int, verdict: Verdict, attempts: Sequence[Attempt]
    ) -> NotConverged:
        names = {name for contact in self.full.contacts for name in contact.law.parameters()}
        return NotConverged(
            state.increment + 1,
            reason,
            verdict,
            attempts,
            prefix=self.prefix,
            stiffnesses=[name for name in ("k_t", "k_n") if name in names],
            driven=any(m.force and not m.turns for c in self.full.contacts for m in c.motions),
        )

    # ---- states ----------------------------------------------------------------------------------

    def initial_state(self) -> State:
        """Return the state of a body at rest, or that committed by another problem. Collective."""
        unknowns, coordinate_id = self.full.state(), self.full.coordinate_id
        zero = np.zeros_like(unknowns)
        contacts = tuple(contact.states.committed for contact in self.full.contacts)
        if any(state.commits for state in contacts):
            load = self.full.present_load()
            self.full.begin(load)
            bulk = self.full.with_obstacles(self.full.bulk.assemble_residual())
            forces: dict[object, Forces] = {coordinate_id: self.full.present_forces(bulk)}
            return State(unknowns, contacts, load, EnergyState.at(forces, self.full.contacts), zero)
        forces = {coordinate_id: Forces.zero(unknowns, self.full.partition)}
        energy = EnergyState.unloaded(forces, self.full.contacts)
        return State(unknowns, contacts, zero, energy, zero)

    def restore(self, present: State | Trial, unknowns: Array | None = None) -> None:
        """Set u and the contacts to those of a state, or u to ``unknowns``. Collective."""
        self.full.set_state(present.unknowns if unknowns is None else unknowns)
        for contact, state in zip(self.full.contacts, present.contacts, strict=True):
            contact.states.restore(state if isinstance(state, ContactTrial) else None)

    def restore_committed_pairs(self, committed: State) -> None:
        """Restore the committed state of contacts whose pairs were replaced. Collective."""
        for contact, state in zip(self.full.contacts, committed.contacts, strict=True):
            follows = contact.contact_kinematics.pairs_follow_bodies
            if not follows and contact.pairs.jump_map is not state.kinematics.pairs.jump_map:
                contact.states.restore()

    def recover_interior(
        self, present: State | Trial, number: int
    ) -> tuple[State | Trial, Verdict]:
        """Recover the interior displacement of the increment solved last. Collective.

        Args:
            present: The trial state of the increment, or the committed state.
            number: Number of the increment.

        Returns:
            The state with the interior displacement, and the verdict.

        Raises:
            NotConverged: The equations do not hold on all unknowns; u is unchanged.
        """
        if isinstance(present, State):
            for contact in self.full.contacts:
                contact.states.restore()
        before = self.full.state()
        self.solver.system.complete(present.interior)
        self.full.begin(present.load)
        verdict, forces = self.verify_system(self.full, self.full.product_force())
        if verdict.failures:
            self.full.set_state(before)
            reason = int(self.solver.snes.getConvergedReason())
            raise NotConverged(number, reason, verdict, prefix=self.prefix)
        energy = present.energy.with_forces(self.full.coordinate_id, forces)
        completed = replace(present, unknowns=self.full.state(), interior=None, energy=energy)
        return completed, verdict

    # ---- verification ----------------------------------------------------------------------------

    def _compute_energy(self, state: State, energies: EnergyState, points: PairIteration) -> Energy:
        """Return the energies of the increment from a committed state. Collective."""
        start, coordinate_id = state.energy, self.solver.system.coordinate_id
        if self.full.coordinate_id not in energies.forces and coordinate_id not in start.forces:
            # From rest, and on the retained dofs only: there are no forces at the start.
            zero = Forces.zero(np.zeros(1), Partition(np.zeros(1, dtype=np.intp), 1))
            start = start.with_forces(coordinate_id, zero)
        if points.replaced:
            start = start.with_committed_jumps(self.full.contacts)
        return energies.compute_energy(start, self.full.contacts, self.full.scales)

    def _verify_all(
        self, initial_unknowns: Array, *, kinematics: bool, assemble: bool
    ) -> tuple[Verdict, EnergyState]:
        """Verify a complete u with the assembled residual of the bulk, or K u. Collective."""
        if assemble:
            bulk = self.full.with_obstacles(self.full.bulk.assemble_residual())
        else:
            bulk = self.full.product_force()
        verdict, own = self.verify_system(
            self.full, bulk, initial_unknowns=initial_unknowns, kinematics=kinematics
        )
        forces: dict[object, Forces] = {self.full.coordinate_id: own}
        if self.solver.condensed and self.full.bulk.symmetric:
            forces[self.solver.system.coordinate_id] = self.solver.system.present_forces()
        return verdict, EnergyState.at(forces, self.full.contacts)

    def _verify_retained(
        self, initial_unknowns: Array, *, kinematics: bool
    ) -> tuple[Verdict, EnergyState]:
        """Verify the condensed equations, without the interior displacement. Collective."""
        system = self.solver.system
        verdict, forces = self.verify_system(
            system, system.bulk_force(), initial_unknowns=initial_unknowns, kinematics=kinematics
        )
        return verdict, EnergyState.at({system.coordinate_id: forces}, self.full.contacts)

    def verify_system(
        self,
        system: System,
        bulk: Array,
        *,
        initial_unknowns: Array | None = None,
        kinematics: bool = False,
    ) -> tuple[Verdict, Forces]:
        """Verify the increment solved last by `Verifier.verify`. Collective.

        With ``kinematics`` the small-displacement error is estimated.
        """
        equations = self.solver.equations
        return self.verifier.verify(
            system,
            bulk,
            start=equations.initial_forces,
            rtol=equations.rtol,
            initial_unknowns=initial_unknowns,
            respond=self.solver.respond if kinematics else None,
        )
