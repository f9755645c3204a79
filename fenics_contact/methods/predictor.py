"""Predictor of an increment: the initial guess with the least residual of several candidates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fenics_contact.contact.point_law import PointTangent
from fenics_contact.contact.values import PointValues
from fenics_contact.methods.equations import Equations
from fenics_contact.parallel import broadcast_from_root, global_max, global_sum
from fenics_contact.systems import dense, linear
from fenics_contact.systems.least_motion import find_least_motion
from fenics_contact.systems.system import System
from fenics_contact.tolerances import FLAT, NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["Predictor"]

# Largest ratio of residual to least residual at which the step by the last tangent is preferred.
_MAX_RESIDUAL_RATIO = 100.0


@dataclass(frozen=True)
class _ConvergedContact:
    """State of a contact in a solution.

    Attributes:
        values: Values at the points.
        tangent: Tangent of the tractions.
        displacement: Displacement of the points, (n_points, gdim) (length).
    """

    values: PointValues
    tangent: PointTangent
    displacement: Array


class Predictor:
    """Initial guesses based on the last increment.

    Attributes:
        change: Change of the state of the full system in the last committed increment; None if
            unknown.
        expected: The state at the end of the increment without new contact, or with the previous
            pairs; None if unknown.
    """

    def __init__(self, equations: Equations) -> None:
        self.expected: Array | None = None
        self.change: Array | None = None
        self._equations = equations
        self._prescribed_change: Array | None = None  # change of the prescribed values
        self._converged: list[_ConvergedContact] = []  # of the last solution
        self._predict = False  # whether a step with its tangent may be chosen

    def store_prescribed_change(self, before: Array) -> None:
        """Store the change of prescribed values since ``before``, of a nonlinear bulk. Collective.

        ``before`` is the state of the full system at the end of the last increment.
        """
        full = self._equations.full
        self._prescribed_change = None
        if not full.bulk.linear:
            vector = full.vector()
            vector.array[:] = full.state() - before
            self._prescribed_change = vector.array.copy() if vector.norm() > 0 else None

    def store_solution(self, *, predict: bool) -> None:
        """Store the contacts of a solution whose tangent is factored. Collective.

        ``predict`` is whether a step with this tangent may be chosen.
        """
        self._equations.has_solution_tangent, self._predict = True, predict
        self.store_converged_contacts()

    def store_converged_contacts(self) -> None:
        """Store values, tangents and displacements of contacts with rigid obstacles. Collective."""
        self._converged = []
        contacts = self._equations.contacts
        if not any(contact.contact_kinematics.is_rigid for contact in contacts):
            return
        for contact in contacts:
            contact.evaluate()
            displacement = contact.contact_kinematics.present_jump()
            self._converged.append(
                _ConvergedContact(contact.values, contact.effective_law.tangent(), displacement)
            )

    def choose_initial_guess(self, *, first_augmentation: bool, was_unloaded: bool) -> Array:
        """Choose the initial guess of the unknowns nearest to equilibrium. Collective.

        Candidates are the present state, a Newton step from it with the tangent of the last
        solution (`_step_by_tangent`; with a nonlinear bulk and changed prescribed values
        `_step_by_prescribed_change`) or without one an extrapolation of the last increment
        (`_extrapolate`), and the expected end.

        At the present state all closed points stick: Newton's method takes about ten iterations
        until they slip again, from the edge of the contact inwards, and a body under a sliding one
        is dragged along, near equilibrium but far from the solution. The step with the last tangent
        has the correct slipping points: it is preferred unless its residual is much larger or
        friction does positive work, after a reversal of the load.

        Args:
            first_augmentation: Whether loads and obstacles have changed, not only multipliers.
            was_unloaded: Whether there was no contact force before.
        """
        equations, system = self._equations, self._equations.system
        present: Array = system.state()
        # The residual retains the round-off of the terms at the first initial guess.
        terms: Array = system.by_body(system.roundoff_magnitude(present))[0]
        terms = np.asarray(np.hypot(terms, system.outside[1]), dtype=np.float64)
        # The last matrix may be that of an overflowing step.
        terms = np.where(np.isfinite(terms), terms, 0.0)
        initial_forces = equations.initial_forces
        equations.initial_forces = replace(
            initial_forces, terms=np.maximum(initial_forces.terms, terms)
        )
        candidates: list[Array] = []
        residuals: list[float] = []

        def add(start: Array) -> int:
            candidates.append(start)
            residual = equations.residual_at(start)
            residuals.append(residual if np.isfinite(residual) else np.inf)
            return len(candidates) - 1

        add(present)
        forces = equations.function.array_r.copy()
        # After an increment without contact force its tangent does not predict this one.
        factored = equations.has_solution_tangent and not was_unloaded
        predicts = factored and self._predict
        equations.has_solution_tangent = False
        step = None  # index of the candidate by the tangent of the last solution
        is_reversed = False
        if self._prescribed_change is not None:
            if predicts:
                step = add(self._step_by_prescribed_change(present))
                is_reversed = self._has_friction_work()
            if step is None or is_reversed or not residuals[step] < residuals[0]:
                step = None
                add(self._step_by_prescribed_change(present, reassemble=True))
        else:
            tractions = self._predict_tractions() if factored and first_augmentation else None
            if tractions is not None or (predicts and equations.full.bulk.linear):
                stepped = self._step_by_tangent(present, tractions)
                if stepped is not None:
                    step = add(stepped)
                    is_reversed = self._has_friction_work()
        self._prescribed_change = None
        if first_augmentation and not predicts and not was_unloaded and self.change is not None:
            add(self._extrapolate(present, forces, self.change))
        if self.expected is not None and first_augmentation:
            add(system.restrict(self.expected))
        if (
            step is not None
            and not is_reversed
            and residuals[step] <= _MAX_RESIDUAL_RATIO * min(residuals)
        ):
            return candidates[step]
        return candidates[int(np.argmin(residuals))]

    def _extrapolate(self, present: Array, forces: Array, change: Array) -> Array:
        """Extrapolate the last increment to zero residual along its direction. Collective.

        The secant over the whole increment makes the result independent of its size.
        """
        equations, system = self._equations, self._equations.system
        path = system.restrict(change).copy()
        path[system.constrained] = 0.0
        equations.residual_at(present + path)
        work = np.array([forces @ path, equations.function.array_r @ path])
        first, last = equations.full.unknowns.comm.allreduce(work)
        has_curvature = np.isfinite(last) and abs(first - last) > FLAT * abs(first)
        return present + first / (first - last) * path if has_curvature else present

    def _has_friction_work(self) -> bool:
        """Return whether committed friction does positive work up to the last guess. Collective."""
        work = 0.0
        for contact in self._equations.contacts:
            contact.evaluate()
            values = contact.values
            power = np.einsum("qi,qi->q", values.old_traction, values.increment)
            work += float(contact.measure @ power)
        return bool(self._equations.full.unknowns.comm.allreduce(work) > 0.0)

    def _step_by_prescribed_change(self, present: Array, *, reassemble: bool = False) -> Array:
        """Predict the effect of changed prescribed values by one linear step. Collective.

        New prescribed values alone may invert cells of a nonlinear bulk next to the boundary, from
        which no iteration recovers.

        Args:
            present: The state with the present prescribed values.
            reassemble: Whether to assemble the tangent at the end of the last increment, with all
                closed points sticking; by default the last factored one is used, with slipping
                points.

        Returns:
            The predicted state, or ``present`` if the step failed.
        """
        equations, full = self._equations, self._equations.full
        change, image, step = full.vector(), full.vector(), full.vector()
        assert self._prescribed_change is not None
        change.array[:] = self._prescribed_change
        full.set_state(present - self._prescribed_change)
        full.update_stiffness()
        ksp = equations.solvers[True]
        if reassemble:
            full.evaluate()
            matrix = equations.matrix(True)
            equations.assemble(matrix, equations.regularised_tangents())
        assert full.stiffness is not None
        full.stiffness.mult(change, image)
        tractions = None if reassemble else self._predict_tractions()
        if tractions is not None:
            for operator, converged, traction in zip(
                full.operators, self._converged, tractions, strict=True
            ):
                operator.add_force(image, traction - converged.values.total_traction)
        image.array[full.constrained] = 0.0
        image.scale(-1.0 / full.bulk.scale)
        ksp.solve(image, step)
        solved = ksp.getConvergedReason() > 0
        linear.reset_failed_factorisation(ksp.getPC())
        full.set_state(present)
        full.update_stiffness()
        if not solved:
            return present
        increment: Array = step.array.copy()
        return present + (
            increment if reassemble else self._replace_modes(full, present, increment)
        )

    def _step_by_tangent(self, present: Array, tractions: list[Array] | None) -> Array | None:
        """Compute one Newton step with the last factored tangent. Collective.

        Args:
            present: The state of the last residual.
            tractions: Tractions of `_predict_tractions` in place of those of the residual, in which
                a moved obstacle penetrates open points and does not stick; None: the residual.

        Returns:
            The state; None if the step failed.
        """
        equations, system = self._equations, self._equations.system
        forces, step = system.vector(), system.vector()
        if tractions is None:
            equations.function.copy(forces)
            forces.scale(equations.length)
        else:
            system.set_state(present)
            forces.array[:] = system.bulk_force()
            for operator, traction in zip(system.operators, tractions, strict=True):
                operator.add_force(forces, traction)
            forces.array[system.constrained] = 0.0
            forces.scale(1.0 / equations.full.bulk.scale)
        ksp = equations.solvers[True]
        ksp.solve(forces, step)
        dense.raise_stored_error(ksp)
        solved = ksp.getConvergedReason() > 0
        linear.reset_failed_factorisation(ksp.getPC())
        increment: Array = -step.array_r
        for vector in (forces, step):
            vector.destroy()
        return present + self._replace_modes(system, present, increment) if solved else None

    def _predict_tractions(self) -> list[Array] | None:
        """Linearise the last tractions with respect to the motion of the obstacles. Collective.

        Returns:
            (n_points, gdim) (stress) for every contact; None: no obstacle has moved, or Γc has.
        """
        equations, tractions, moved = self._equations, [], False
        comm, scales = equations.full.unknowns.comm, equations.full.scales
        if not self._converged:
            return None
        for number, (contact, converged) in enumerate(
            zip(equations.contacts, self._converged, strict=True)
        ):
            kinematics, traction = contact.contact_kinematics, converged.values.total_traction
            change = np.linalg.norm(kinematics.present_jump() - converged.displacement, axis=1)
            if global_max(comm, change / scales.size_at_points(number)) > NEGLIGIBLE:
                return None
            if contact.contact_kinematics.is_rigid:
                # A moved obstacle displaces sticking points, and rotates tractions.
                values = contact.states.evaluate_present()
                offset = kinematics.rotate(converged.values.jump - values.jump)
                length = np.linalg.norm(offset, axis=1) / scales.size_at_points(number)
                moved = moved or global_max(comm, length) > NEGLIGIBLE
                rotation = kinematics.angle(converged.values) - kinematics.angle(values)
                traction = kinematics.in_frame(traction, rotation)
                traction = traction - np.einsum("qij,qj->qi", converged.tangent.by_jump, offset)
            tractions.append(traction)
        return tractions if moved else None

    def _replace_modes(self, system: System, present: Array, step: Array) -> Array:
        """Replace the components of a step along regularised modes. Collective.

        At a solution the regularisation nearly vanishes, and these components may be arbitrarily
        large. They become the least ones without penetration by the rest of the step.
        """
        equations, full, motions = self._equations, self._equations.full, self._equations.motions
        modes = motions.project_on_free(equations.regularised_modes)
        if not len(modes):
            return step
        comm = full.unknowns.comm
        free = [np.where(full.constrained, 0.0, field) for field in motions.present_fields()]
        all_modes = np.array([system.restrict(field) for field in free])
        fields = modes @ all_modes
        sums = global_sum(comm, np.column_stack([fields @ fields.T, fields @ step]))
        coefficients = broadcast_from_root(
            comm, np.linalg.lstsq(sums[:, :-1], sums[:, -1], rcond=NEGLIGIBLE)[0]
        )
        step = step - coefficients @ fields
        system.set_state(present)
        states, has_force, closing = [], [], []
        for number, operator in enumerate(system.operators):
            contact, values = operator.contact, operator.contact.states.evaluate_present()
            committed = contact.states.committed.points or values
            has_force.append(motions.has_force(number, contact, committed)[0])
            normal = np.where(np.isfinite(values.normal), values.normal, 0.0)
            closing.append(np.einsum("qd,qd->q", operator.jump(step), normal))
            states.append(values)
        zeros, may_close = np.zeros(len(motions.free)), [~each for each in has_force]
        least = find_least_motion(full, motions, modes, states, zeros, may_close, closing)
        return step if least is None else step + least @ all_modes
