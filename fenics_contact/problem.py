"""The contact problem: its committed state, and the solution of increments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.arguments import check_bool, listed
from fenics_contact.checks.input_validation import (
    check_contacts,
    check_tolerance,
    check_undeformed_geometry,
    find_constrained_unknowns,
    find_displacement,
)
from fenics_contact.checks.verdict import Verdict
from fenics_contact.checks.verifier import Verifier
from fenics_contact.contact.contact import Contact
from fenics_contact.failure import NotConverged
from fenics_contact.increment import Increment, IncrementSolver, Retry
from fenics_contact.methods.callbacks import defer_interrupts, release_interrupt
from fenics_contact.methods.load_balance import find_free_modes
from fenics_contact.methods.pair_iteration import PairIteration
from fenics_contact.methods.solver import Settings, Solver
from fenics_contact.parallel import raise_collectively, warn
from fenics_contact.state import State, Trial
from fenics_contact.step import Step
from fenics_contact.surface.displacement import Displacement
from fenics_contact.systems import linear
from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.modulus_tracking import TrackedModulus
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.systems.unknowns import Unknowns
from fenics_contact.types import Array

__all__ = ["ContactProblem"]


class ContactProblem:
    """The nonlinear problem of one or several bodies with contacts, solved increment by increment.

    The residual is F(u; v) plus the virtual work of the contacts, eq. (9)::

        problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])
        step = problem.solve()  # with the present loads; verified
        problem.commit()  # the solution becomes the history

    `increments` does this for a load history. PETSc's SNES solves in dimensionless unknowns:
    displacements are divided by the size of the mesh, stiffness by the largest diagonal entry of
    the bulk. Options are read under ``prefix``, for example ``-contact_snes_monitor``; the command
    line takes precedence over ``petsc_options``, and these over the settings of ``method``. The
    constructor is collective: it compiles the forms and checks the input.

    Args:
        F: Residual F(u; v) of the bulk with all loads, without contact.
        u: Displacement, or a mixed function w with, for instance, a pressure; its values are the
            initial state. Contacts of a mixed function have the displacement of ``ufl.split(w)``.
        bcs: Dirichlet conditions on ``u`` or its components, or on parts of w.
        contacts: Contacts of ``u``.
        method: "newton": Newton's method with the consistent tangent. "lbfgs": quasi-Newton with
            H₀ = (K + αK_n + φK_t)⁻¹. "continuation": Newton's method with increasing contact
            stiffness. "primal_dual": primal-dual active set method for friction, with tractions and
            displacements as unknowns, for small displacements of a linear bulk and obstacles
            without unknown motions. "alternating": fixed-point iteration on the friction bound of
            Tresca problems, solved as minimisations by Newton's method with a line search on the
            energy; not for mixed functions. By default "newton"; for a linear bulk on all unknowns
            "lbfgs" by multigrid, and in three dimensions if no bodies slide on each other with
            finite kinematics. After a failure "primal_dual", "continuation" and "alternating"
            follow where they apply.
        alpha: Factor α of the normal contact stiffness in H₀, 0 to 1 (source paper: 1).
        phi: Factor φ of the tangential contact stiffness of sticking points in H₀, 0 to 1 (source
            paper: 0). With 1 a third of the iterations suffices once points stick.
        fallback: Whether other methods are tried after a failure, unless an option sets the limit
            on iterations below its default.
        condensation: Whether to eliminate the dofs of a linear bulk away from the contact by static
            condensation, eq. (11). If Γc is large, only the dofs near the active contact zone are
            retained, and selected again when it moves or grows. By default it is used if possible
            and faster, unless an option names a linear solver.
        linear_solver: "direct" (MUMPS) or "multigrid" (GAMG: one V-cycle as H₀ of L-BFGS, or the
            preconditioner of CG and GMRES in Newton's method), without condensation. By
            default multigrid for three-dimensional problems that it solves faster, and where the
            factors would not fit in half of the memory. Obstacles with unknown motions need
            "direct". The log reports the choice.
        petsc_options: PETSc options without the prefix.
        prefix: Prefix of the PETSc options.
        small_displacement_tolerance: Largest relative error of the contact force and pressure
            (between two bodies: of the force) due to the assumption of small displacements. An
            increment with a larger error fails, or one in which points slide off their opposite
            points (`DeformableBody.update_pairs`); from 1 % on there is a warning. With infinity no
            increment fails for this reason, and pairs are not updated within an increment.
        cross_check: Whether contact forces are compared with those that DOLFINx assembles from the
            boundary form, at the cost of one form per contact and one assembly per increment.

    Attributes:
        u: The function that is solved for: the displacement, or a mixed function.
        displacement: The displacement as a part of u.
        contacts: The contacts.
        full: The system on all unknowns.
        modulus: Young's modulus at Γc, for stiffnesses that are multiples of E/h.
        motions: The rigid-body modes of the bodies, and which of them are free.
        solver: The solver of an increment: system, methods and SNES.
        accuracy: The strictest `Accuracy` of the contacts; None if any contact has none.
        initial_penetration: Largest penetration of the undeformed body (length), without an
            interference prescribed by ``gap``.

    Raises:
        ValueError: Invalid input; raised on all ranks.
    """

    def __init__(
        self,
        F: ufl.Form,
        u: fem.Function,
        *,
        bcs: Sequence[fem.DirichletBC] = (),
        contacts: Sequence[Contact] = (),
        method: str | None = None,
        alpha: float = 1.0,
        phi: float = 1.0,
        fallback: bool = True,
        condensation: bool | None = None,
        linear_solver: str | None = None,
        petsc_options: Mapping[str, Any] | None = None,
        prefix: str = "contact_",
        small_displacement_tolerance: float = 0.2,
        cross_check: bool = False,
    ) -> None:
        tolerance = check_tolerance(small_displacement_tolerance)
        self.contacts = listed("contacts", contacts, Contact)
        bcs = listed("bcs", bcs, fem.DirichletBC)
        levels = [c.accuracy for c in self.contacts if c.accuracy is not None]
        complete = bool(levels) and len(levels) == len(self.contacts)
        self.accuracy = min(levels, key=lambda a: a.error) if complete else None
        settings = Settings(
            method=method,
            alpha=alpha,
            phi=phi,
            fallback=fallback,
            condensation=condensation,
            linear_solver=linear_solver,
            petsc_options={} if petsc_options is None else petsc_options,
            prefix=prefix,
            accuracy=self.accuracy,
        )
        self.displacement = find_displacement(u, self.contacts)
        self.u = u
        self._prefix, self._comm = prefix, u.function_space.mesh.comm
        if self._comm.rank == 0:
            linear.warn_of_slow_blas()
        self.full = _create_system(F, self.displacement, self.contacts, bcs)
        self.modulus = TrackedModulus(self.full.bulk, self.displacement, self.contacts)
        self.motions = RigidBodyModes(self.full)
        self.initial_penetration = check_undeformed_geometry(self.contacts)
        find_free_modes(self.motions, self.full)
        self.full.scales.begin(self.full.operators)
        verifier = Verifier(self.full, self.motions, tolerance=tolerance, cross_check=cross_check)
        self.solver = Solver(self.full, self.motions, settings)
        self._increments = IncrementSolver(self.full, self.solver, verifier, self.modulus, prefix)
        self.full.evaluate()
        self.state = self._increments.initial_state()
        self._trial: Trial | None = None
        self._is_first = True  # before the first solution
        self._has_warned = False  # of an increment that was not committed

    @property
    def increment(self) -> int:
        """Number of committed increments."""
        return self.state.increment

    @property
    def present(self) -> State | Trial:
        """The state that was solved last: the trial state if there is one, else the committed."""
        return self._trial or self.state

    @property
    def snes(self) -> PETSc.SNES:
        """The main PETSc solver.

        Setting `expected_increments`, as `increments` does, may replace it before the first
        solution: monitors are transferred; set everything else by options.
        """
        return self.solver.snes

    @property
    def small_displacement_tolerance(self) -> float:
        """Largest relative error accepted of the small-displacement assumption; settable.

        It limits the errors of contact force and pressure, between two bodies of the force only.
        """
        return self._increments.verifier.small_displacement_tolerance

    @small_displacement_tolerance.setter
    def small_displacement_tolerance(self, tolerance: float) -> None:
        self._increments.verifier.small_displacement_tolerance = tolerance

    @property
    def expected_increments(self) -> int:
        """Number of increments that the choice of the linear solver assumes, 4 unless it is set.

        `increments` sets it. Set it (collective) before the first solution of your own loop over
        many increments: static condensation pays for many of them, multigrid for few.
        """
        return self.solver.expected_increments

    @expected_increments.setter
    def expected_increments(self, number: int) -> None:
        if not (isinstance(number, int | np.integer) and number >= 1):
            raise ValueError(
                f"expected_increments is {number!r}; it must be an integer, at least 1"
            )
        if self._is_first:
            self.solver.set_expected_increments(int(number))

    # ---- state and linearisation -----------------------------------------------------------------

    @property
    def default_increments(self) -> int:
        """Default number of increments of a load history, by `Accuracy`; 1 without one."""
        friction = any(c.law.has_friction for c in self.contacts)
        return self.accuracy.increments if self.accuracy and friction else 1

    def present_state(self) -> Array:
        """Return a copy of this rank's present unknowns (length). Collective.

        The interior displacement is recovered first, if it is out of date.
        """
        self.complete()
        return self.full.state()

    # ---- solving ---------------------------------------------------------------------------------

    @defer_interrupts()
    def solve(self, *, recover_interior: bool = True) -> Step:
        """Solve the next increment with the present loads and conditions. Collective.

        The history does not change until `commit`.

        Args:
            recover_interior: Whether to recover the interior displacement after static
                condensation. If False, u away from the contact may remain that of an earlier
                increment, and the condensed equations are verified. `complete` recovers the
                interior, for 1/15 to 1/30 of the cost of a factorisation. If only a part of Γc is
                retained, the interior is always recovered, to verify that the rest is open.

        Returns:
            The `Step`, with the verdict.

        Raises:
            NotConverged: There is no verified solution; u and history are unchanged.
            ValueError: The input is not finite or out of range, or contact cannot balance the load.
        """
        check_bool("recover_interior", recover_interior)
        updates_pairs = self.small_displacement_tolerance < np.inf
        points = PairIteration(self.full, self.contacts if updates_pairs else [])
        increment = Increment(recover_interior, points)
        self._check_committed()
        self.state.check_contacts(self.contacts)
        is_first, self._is_first = self._is_first, False
        if is_first:
            for contact in self.contacts:
                contact.states.begin()
            self.state = replace(
                self.state, contacts=tuple(c.states.committed for c in self.contacts)
            )
            if not self.full.bulk.linear:  # u and its tangent may have changed
                self._increments.modulus.measure()
        incomplete = any(state.interior is not None for state in (self.present, self.state))
        if incomplete and not self.solver.is_current():
            self._complete_all()  # before its factors are discarded
        self.solver.equations.factorisations = 0
        start_unknowns = self.full.state()
        # A failed iteration may leave a diagonal whose round-off would accept any residual.
        diagonal = None if self.full.bulk.linear else self.full.diagonal
        at_present = self._is_present(start_unknowns)
        self._increments.restore_committed_pairs(self.state)

        def reset() -> None:
            # The interior of the present state may have been recovered meanwhile.
            self._increments.restore(self.present, None if at_present else start_unknowns)
            if diagonal is not None:
                self.full.diagonal = diagonal

        try:
            # A line search may overflow, which the convergence test and the verdict detect. A
            # warning must not become an error on one rank alone.
            with np.errstate(all="ignore"):
                while True:
                    with self.solver.options.present():
                        result = self._increments.attempt(increment, self.state, self.present)
                    if not isinstance(result, Retry):
                        break
                    if result is Retry.PAIRS:
                        self._find_pairs(points)
                    reset()
                    self._increments.restore_committed_pairs(self.state)
                    points.begin(self.contacts)
                    # After the block, in which a new SNES would take the solver's options for the
                    # user's.
                    if result is Retry.UNKNOWNS:
                        count = sum(each.outcome == result.value for each in increment.attempts)
                        self.solver.change_dofs(can_drop=count <= 1)
                release_interrupt()
        except BaseException as error:
            raise_collectively(self._comm, error)
            reset()
            if not isinstance(error, NotConverged | ValueError):
                self.solver.recover_from_error()
            raise
        finally:
            if self._comm.rank == 0:
                self.solver.options.warn_of_unused(self._prefix)
        self._trial, step = result
        return step

    def _find_pairs(self, points: PairIteration) -> None:
        """Find the opposite points in the states chosen for them. Collective."""
        if any(state.interior is not None for state in (self.present, self.state)):
            # The search needs the interior, which cannot be recovered after a change of pairs.
            self._increments.restore(self.present)
            self._complete_all()
        points.find(self.state.unknowns)

    def _is_present(self, unknowns: Array) -> bool:
        """Whether unknowns are those of the present state. Collective."""
        differs = not np.array_equal(unknowns, self.present.unknowns)
        return not self._comm.allreduce(int(differs))

    def _check_committed(self) -> None:
        """Warn once if an increment with friction is solved again without a commit."""
        friction = any(contact.law.has_friction for contact in self.contacts)
        if self._trial is None or self._has_warned or not friction:
            return
        self._has_warned = True
        warn(
            self._comm,
            f"increment {self.increment + 1} was solved but not committed, and is solved again "
            "from the same state: call commit() to accept an increment, or restore() to discard it",
        )

    def complete(self) -> Verdict | None:
        """Recover the interior displacement of the increment solved last. Collective.

        It is needed after `solve` or `increments` with ``recover_interior``. The product of the
        bulk's matrix with the field must balance loads and contact forces.

        Returns:
            The verdict; None if u was complete.

        Raises:
            NotConverged: The equations do not hold on all unknowns.
        """
        present = self.present
        if present.interior is None:
            return None
        number = self.increment + (self._trial is not None)
        completed, verdict = self._increments.recover_interior(present, number)
        if isinstance(completed, State):
            self.state = completed
        else:
            self._trial = completed
        return verdict

    def _complete_all(self) -> None:
        """Recover the interior of the present and of the committed state. Collective."""
        self.complete()
        trial, unknowns = self._trial, self.full.state()
        if trial is None or self.state.interior is None:
            return
        try:
            self.restore()
            self.complete()
        finally:
            self._trial = trial
            self._increments.restore(self.present, unknowns)

    @defer_interrupts()
    def commit(self) -> None:
        """Make the solved state the start of the next increment, with its history. Collective.

        The committed state is the one that `solve` found, even if constants or u have been changed
        since. There is no effect without a new solution; if the commit fails, none on the history.
        """
        if self._trial is None:
            return
        trials = zip(self.contacts, self._trial.contacts, strict=True)
        needs_update = [
            contact.contact_kinematics.needs_pair_update(trial.points) for contact, trial in trials
        ]
        if any(needs_update):  # which needs a complete u
            self.complete()
        trial, start = self._trial, self.state
        try:
            self.full.set_state(trial.unknowns)
            for contact, solved in zip(self.contacts, trial.contacts, strict=True):
                contact.states.commit(solved)
        except BaseException as error:
            raise_collectively(self._comm, error)
            for contact, state in zip(self.contacts, start.contacts, strict=True):
                contact.states.set_state(state)
            self.restore()
            raise
        complete = trial.interior is None and start.interior is None
        self.state = State(
            unknowns=self.full.state(),
            contacts=tuple(contact.states.committed for contact in self.contacts),
            load=trial.load,
            energy=trial.energy.with_committed_jumps(self.contacts),
            change=trial.unknowns - start.unknowns if complete else None,
            load_change=trial.load - start.load,
            interior=trial.interior,
            increment=start.increment + 1,
        )
        self._trial = None

    def restore(self) -> None:
        """Discard an uncommitted increment, and reset u to the last commit. Collective."""
        self._trial = None
        self._increments.restore(self.state)

    def continue_from(self, state: State) -> None:
        """Make a state of another run the committed one. Collective.

        Args:
            state: The state; u and the contacts have its values.
        """
        self._is_first, self._trial = False, None
        self.state = state
        self.restart_solver()

    def restart_solver(self) -> None:
        """Discard what the solver stores from earlier increments. Collective."""
        self.solver.clear_history()
        energy, coordinate_id = self.state.energy, self.full.coordinate_id
        forces = {coordinate_id: energy.forces[coordinate_id]}
        self.state = replace(self.state, energy=replace(energy, forces=forces))


def _create_system(
    F: ufl.Form,
    displacement: Displacement,
    contacts: Sequence[Contact],
    bcs: Sequence[fem.DirichletBC],
) -> FullSystem:
    """Check the input and create the system on all unknowns. Collective."""
    bulk = Bulk(F, displacement)
    u, n_motions = displacement.whole, sum(len(contact.motions) for contact in contacts)
    unknowns = Unknowns(u.function_space, n_motions)
    constrained = find_constrained_unknowns(bcs, u, unknowns, mixed=displacement.is_mixed)
    check_contacts(contacts, displacement, constrained)
    full = FullSystem(displacement, unknowns, bulk, contacts, constrained, bcs)
    bulk.check_finite()
    full.update_stiffness()
    bulk.check_elastic()
    return full
