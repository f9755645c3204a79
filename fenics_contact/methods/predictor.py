"""Predictor of an increment: of several states, the one with the least residual."""

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

# A start with up to this many times the residual of the best is taken if its points slip.
_FAR = 100.0


@dataclass(frozen=True)
class _ConvergedContact:
    """What a contact bore in a solution.

    Attributes:
        values: At the points.
        tangent: Of the tractions there.
        displacement: Of the points, (n_points, gdim) (length).
    """

    values: PointValues
    tangent: PointTangent
    displacement: Array


class Predictor:
    """States to start from, by what is known of the last increment.

    Attributes:
        factored: Whether the consistent tangent factored last is that of a solution.
        predict: Whether a step on it may be chosen.
        change: By what the last committed increment changed the state of the full system; None:
            it is not known.
        expected: The state in which the increment ends if nothing touches that was apart, or in
            which it ended between other pairs; None: it is not known.
    """

    def __init__(self, equations: Equations) -> None:
        self.factored = self.predict = False
        self.expected: Array | None = None
        self.change: Array | None = None
        self._equations = equations
        self._moved: Array | None = None  # of the values prescribed, since the last increment
        self._converged: list[_ConvergedContact] = []  # by contact, in the solution found last

    def moved_from(self, before: Array) -> None:
        """Take note of what the values prescribed now changed. Collective.

        Args:
            before: The state of the full system in which the last increment ended.
        """
        full = self._equations.full
        self._moved = None
        if not full.bulk.linear:
            change = full.vector()
            change.array[:] = full.state() - before
            self._moved = change.array.copy() if change.norm() > 0 else None

    def forget(self) -> None:
        """Another tangent is factored than that of the solution found last."""
        self.factored = self.predict = False

    def keep(self, *, predict: bool) -> None:
        """Take note of what contacts bear in the solution that was just found. Collective.

        Its tangent is factored. Obstacles that move by the next increment take those points along
        that stick, and no others.

        Args:
            predict: See the attribute.
        """
        self.factored, self.predict = True, predict
        self.store_converged_contacts()

    def store_converged_contacts(self) -> None:
        """Take note of what contacts bear, in the solution or where it has moved. Collective."""
        self._converged = []
        contacts = self._equations.contacts
        if not any(contact.rigid for contact in contacts):
            return
        for contact in contacts:
            contact.evaluate()
            displacement = contact.contact_kinematics.present_jump()
            self._converged.append(
                _ConvergedContact(contact.values, contact.effective_law.tangent(), displacement)
            )

    def choose(self, *, first_round: bool, cold: bool) -> Array:
        """Choose the unknowns of the system to start from: what is nearest to equilibrium of these.

        Collective. The present state; that state with one step of Newton's method on the tangent of
        the last solution (`_stepped`, with a nonlinear bulk and other prescribed values
        `_followed`), or where there is none continued as in the last increment (`_continued`); and
        where it is expected to end.

        At the present state itself no point has slipped yet, and all closed ones stick: from there
        Newton's method takes ten steps to let them slip again, one after another from the edge of
        the contact inwards; and a body that others slide over is dragged along by all of the way,
        in a state that is near equilibrium and far from the solution. The start by a step on the
        tangent of the last solution has the right ones slipping, and is chosen unless it is far
        off, or goes where friction pulls: then the load has turned round, and they stick.

        Args:
            first_round: Whether loads and obstacles, and not multipliers, are what changed.
            cold: Whether nothing was borne before.
        """
        equations, system = self._equations, self._equations.system
        present: Array = system.state()
        # What a step from here takes away leaves the round-off of what was there.
        terms: Array = system.by_body(system.terms(present))[0]
        terms = np.asarray(np.hypot(terms, system.outside[1]), dtype=np.float64)
        # The last matrix may be that of a step that overflowed. Later rounds of multipliers have
        # the round-off of the first one's start, too.
        terms = np.where(np.isfinite(terms), terms, 0.0)
        begun = equations.start
        equations.start = replace(begun, terms=np.maximum(begun.terms, terms))
        candidates: list[Array] = []
        residuals: list[float] = []

        def add(start: Array) -> int:
            candidates.append(start)
            residual = equations.residual_at(start)
            residuals.append(residual if np.isfinite(residual) else np.inf)
            return len(candidates) - 1

        add(present)
        forces = equations.function.array_r.copy()
        # Where nothing was borne yet the last increment tells nothing of this one.
        predicts, factored = self.predict and not cold, self.factored and not cold
        self.forget()
        step = None  # which of the candidates is one on the tangent of the last solution
        turned = False
        if self._moved is not None:
            if predicts:
                step = add(self._followed(present))
                turned = self._friction_works()
            if step is None or turned or not residuals[step] < residuals[0]:
                step = None
                add(self._followed(present, anew=True))
        else:
            tractions = self._tractions() if factored and first_round else None
            if tractions is not None or (predicts and equations.full.bulk.linear):
                stepped = self._stepped(present, tractions)
                if stepped is not None:
                    step = add(stepped)
                    turned = self._friction_works()
        self._moved = None
        if first_round and not predicts and not cold and self.change is not None:
            add(self._continued(present, forces, self.change))
        if self.expected is not None and first_round:
            add(system.part(self.expected))
        if step is not None and not turned and residuals[step] <= _FAR * min(residuals):
            return candidates[step]
        return candidates[int(np.argmin(residuals))]

    def _continued(self, present: Array, forces: Array, change: Array) -> Array:
        """Where a change like that of the last increment leaves no force along it. Collective.

        By the secant between none and all of it, so that the sizes of the increments do not matter.

        Args:
            present: The state.
            forces: The residual there.
            change: Of the state of the full system, in that increment.
        """
        equations, system = self._equations, self._equations.system
        way = system.part(change).copy()
        way[system.constrained] = 0.0
        equations.residual_at(present + way)
        along = np.array([forces @ way, equations.function.array_r @ way])
        first, last = equations.full.unknowns.comm.allreduce(along)
        stiff = abs(first - last) > FLAT * abs(first)  # else the way feels no stiffness
        return present + first / (first - last) * way if stiff and np.isfinite(last) else present

    def _friction_works(self) -> bool:
        """Whether committed friction does work on the way to the start added last. Collective."""
        work = 0.0
        for contact in self._equations.contacts:
            contact.evaluate()
            values = contact.values
            power = np.einsum("qi,qi->q", values.old_traction, values.increment)
            work += float(contact.measure @ power)
        return bool(self._equations.full.unknowns.comm.allreduce(work) > 0.0)

    def _followed(self, present: Array, *, anew: bool = False) -> Array:
        """Where the body goes with the values prescribed now, by one step from before. Collective.

        Next to conditions that moved far a nonlinear bulk may be turned inside out, and no
        iteration comes back from there.

        Args:
            present: The state with the values prescribed now.
            anew: Whether to step on the tangent where the last increment ended, at which all closed
                points stick; or else on that factored last, in which those slip that did.

        Returns:
            The state; the present one where no step is found.
        """
        equations, full = self._equations, self._equations.full
        change, image, step = full.vector(), full.vector(), full.vector()
        assert self._moved is not None
        change.array[:] = self._moved
        full.set_state(present - self._moved)
        full.update_stiffness()
        ksp = equations.solvers[True]
        if anew:
            full.evaluate()
            matrix = equations.matrix(True)
            equations.assemble(matrix, equations.regularised_tangents())
        assert full.stiffness is not None
        full.stiffness.mult(change, image)
        tractions = None if anew else self._tractions()
        if tractions is not None:  # obstacles have moved, too
            for operator, borne, traction in zip(
                full.operators, self._converged, tractions, strict=True
            ):
                operator.add_force(image, traction - borne.values.total_traction)
        image.array[full.constrained] = 0.0
        image.scale(-1.0 / full.bulk.scale)
        ksp.solve(image, step)
        found = ksp.getConvergedReason() > 0
        linear.forget_failure(ksp.getPC())
        full.set_state(present)
        full.update_stiffness()
        if not found:
            return present
        way: Array = step.array.copy()
        return present + (way if anew else self._without_regularised_modes(full, present, way))

    def _stepped(self, present: Array, tractions: list[Array] | None) -> Array | None:
        """One Newton step on the tangent factored last. Collective.

        Args:
            present: The state, at which the residual was computed last.
            tractions: What points would bear if those that stuck still did, and all others bore
                what they bore, see `_tractions`: in the residual an obstacle that has moved is deep
                in points that were open, and nothing sticks to it any more; None: the residual is
                what the step is to take away.

        Returns:
            The state; None where no step is found.
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
        found = ksp.getConvergedReason() > 0
        linear.forget_failure(ksp.getPC())
        way: Array = -step.array_r
        for vector in (forces, step):
            vector.destroy()
        return present + self._without_regularised_modes(system, present, way) if found else None

    def _tractions(self) -> list[Array] | None:
        """Those of the last solution, as moved obstacles would change them to first order.

        Collective.

        Returns:
            (n_points, gdim) (stress) for every contact; None: no obstacle has moved, or Γc is not
            where they were found.
        """
        equations, tractions, moved = self._equations, [], False
        comm, scales = equations.full.unknowns.comm, equations.full.scales
        if not self._converged:
            return None
        for number, (contact, borne) in enumerate(
            zip(equations.contacts, self._converged, strict=True)
        ):
            opposite, traction = contact.contact_kinematics, borne.values.total_traction
            change = np.linalg.norm(opposite.present_jump() - borne.displacement, axis=1)
            if global_max(comm, change / scales.size_at_points(number)) > NEGLIGIBLE:
                return None
            if contact.rigid:
                # An obstacle that has moved takes points that stuck along, and turns tractions.
                now = contact.states.evaluate_present()
                way = opposite.turned(borne.values.jump - now.jump)
                length = np.linalg.norm(way, axis=1) / scales.size_at_points(number)
                moved = moved or global_max(comm, length) > NEGLIGIBLE
                turn_back = opposite.angle(borne.values) - opposite.angle(now)
                traction = opposite.in_frame(traction, turn_back)
                traction = traction - np.einsum("qij,qj->qi", borne.tangent.by_jump, way)
            tractions.append(traction)
        return tractions if moved else None

    def _without_regularised_modes(self, system: System, present: Array, way: Array) -> Array:
        """Replace in a step the modes along which its tangent was regularised. Collective.

        At a solution next to nothing is left of what regularises the tangent along such a mode: a
        step by it may go any distance. All else of the step is right, and pushes bodies along these
        modes as far as gaps close by it.

        Args:
            system: The system.
            present: The state from which the step is.
            way: The step.
        """
        equations, full, motions = self._equations, self._equations.full, self._equations.motions
        modes = motions.in_free(equations.regularised_modes)
        if not len(modes):
            return way
        comm = full.unknowns.comm
        free = [np.where(full.constrained, 0.0, field) for field in motions.present_fields()]
        every = np.array([system.part(field) for field in free])
        fields = modes @ every
        sums = global_sum(comm, np.column_stack([fields @ fields.T, fields @ way]))
        share = broadcast_from_root(
            comm, np.linalg.lstsq(sums[:, :-1], sums[:, -1], rcond=NEGLIGIBLE)[0]
        )
        way = way - share @ fields
        system.set_state(present)
        states, bear, closed = [], [], []
        for number, operator in enumerate(system.operators):
            contact, values = operator.contact, operator.contact.states.evaluate_present()
            committed = contact.states.committed.points or values
            bear.append(motions.has_force(number, contact, committed)[0])
            normal = np.where(np.isfinite(values.normal), values.normal, 0.0)
            closed.append(np.einsum("qd,qd->q", operator.jump(way), normal))
            states.append(values)
        nothing, among = np.zeros(len(motions.free)), [~each for each in bear]
        pushed = find_least_motion(full, motions, modes, states, nothing, among, closed)
        return way if pushed is None else way + pushed @ every
