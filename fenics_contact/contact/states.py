"""The states of a contact: the committed state, solved trial states, and the present evaluation."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fenics_contact.contact.contact_kinematics import (
    ContactKinematics,
    ContactParts,
    KinematicsState,
)
from fenics_contact.contact.effective_law import EffectiveLaw
from fenics_contact.contact.multipliers import Multipliers
from fenics_contact.contact.values import PointValues
from fenics_contact.types import Array, Mask

__all__ = ["ContactState", "ContactStates", "ContactTrial"]

logger = logging.getLogger("fenics_contact")


@dataclass(frozen=True)
class ContactState:
    """A committed state of a contact: its history, and the results of the increment before it.

    Attributes:
        history: History variables and multipliers, `PointFields.rows`.
        kinematics: Committed state of the obstacle, and the pairs.
        points: All fields at this rank's points; None before the first commit.
        commits: Number of commits so far.
    """

    history: Array
    kinematics: KinematicsState
    points: PointValues | None = None
    commits: int = 0


@dataclass(frozen=True)
class ContactTrial:
    """A solved state of a contact, which `ContactStates.commit` makes the committed one.

    Attributes:
        points: All fields at this rank's quadrature points.
        history: The fields that become history, by name.
        reference: History at the start of the increment, with the slip reference after initial
            positioning, `PointFields.rows`.
        kinematics: Committed state of the obstacle, and the pairs of this state.
    """

    points: PointValues
    history: Mapping[str, Array]
    reference: Array
    kinematics: KinematicsState


class ContactStates:
    """The committed state of a contact, and the evaluation of the present ``u`` from it.

    The constructor is collective, and takes the present ``u`` as the initial state.

    Attributes:
        committed: The committed state.
        history: A working copy of its history variables, with the slip reference of the increment.
    """

    def __init__(
        self,
        parts: ContactParts,
        multipliers: Multipliers | None,
        kinematics: ContactKinematics,
        effective_law: EffectiveLaw,
    ) -> None:
        self.history = history = parts.history
        self._name, self._law, self._multipliers = parts.name, parts.law, multipliers
        self._kinematics, self._effective_law = kinematics, effective_law
        self._values: PointValues | None = None
        kinematics.reset_reference()
        self.committed = ContactState(history.rows(), kinematics.state())
        self._start()

    @property
    def values(self) -> PointValues:
        """All fields of the last evaluation at this rank's points."""
        if self._values is None:
            self.evaluate()
            assert self._values is not None
        return self._values

    def evaluate(self) -> None:
        """Evaluate gap, tractions and slip at the present ``u`` into `values`. Collective."""
        self._values = self.evaluate_present()

    def evaluate_present(self) -> PointValues:
        """Return the evaluation at the present ``u``, without a change of `values`. Collective."""
        self._kinematics.update()
        arrays = {**self._kinematics.data.values, **self._effective_law.own.evaluate()}
        return PointValues.of(arrays | self._kinematics.outputs(arrays))

    def forget(self) -> None:
        """Discard the last evaluation: the next access to a result evaluates the present ``u``."""
        self._values = None

    def begin(self) -> None:
        """Measure slip from the present ``u`` if nothing has been committed yet. Collective.

        The obstacle is then in its initial position.
        """
        if not self.committed.commits and self._kinematics.reset_reference():
            self._start()

    def _start(self) -> None:
        """Make the present ``u`` the state before the first increment. Collective."""
        if self._law.has_friction:
            start = {name: self.history.values(name) for name in self.history.names}
            self.history.assign(start | self._kinematics.reference_fields())
        self.set_state(ContactState(self.history.rows(), self._kinematics.state()))

    def start_with_pairs(self, kinematics: KinematicsState) -> None:
        """Start the increment with other pairs and their committed jump. Collective."""
        jump_change = kinematics.jump - self._kinematics.committed_jump
        self._kinematics.set_state(kinematics)
        if self._law.has_friction:
            history = {name: self.history.values(name) for name in self.history.names}
            self.history.assign(history | {"jump": history["jump"] + jump_change})
        self.forget()

    def set_slip_reference(self, points: Mask) -> None:
        """Measure slip from the state evaluated last at unloaded points of a mask. Collective.

        `restore` undoes it. Points that were loaded at the last commit keep their reference.
        """
        if not self._law.has_friction:
            return
        points = points & (self.history.values("normal_traction") == 0.0)
        history = {name: self.history.values(name) for name in self.history.names}
        slip_reference = self._kinematics.slip_reference(self.values)
        reference = {n: np.where(points[:, None], v, history[n]) for n, v in slip_reference.items()}
        self.history.assign(history | reference)
        self.forget()

    def trial(self, *, is_loaded: bool = True) -> ContactTrial:
        """Return a copy of the evaluated state, for `commit`.

        Args:
            is_loaded: Whether there is a contact force (`ForceBalance.is_loaded`). If not, all
                normal tractions are smaller than the accepted residual, and zero is committed.
        """
        points = self.values
        values = {n: points.arrays[n] for n in ("opening", "penetration", "normal_traction")}
        if not is_loaded:
            values["normal_traction"] = np.zeros_like(values["normal_traction"])
        if self._law.has_friction:
            values |= {
                "traction": points.framed_traction,
                "jump": points.projection_point,
                "normal": points.framed_normal,
                "slip": self.history.values("slip") + points.slip_increment,
            }
        if self._multipliers is not None:
            values |= self._multipliers.committed(points)
        history = self._kinematics.to_history(values)
        return ContactTrial(points, history, self.history.rows(), self._kinematics.state())

    def commit(self, trial: ContactTrial | None = None) -> None:
        """Make a solved state the history of the next increment. Collective.

        Args:
            trial: A state returned by `trial`; by default the state at the present ``u``.
        """
        if trial is None:
            self.evaluate()
            trial = self.trial()
        # Results remain those of the solution if pairs are updated.
        jump_change = self._kinematics.commit(trial.points)
        history = dict(trial.history)
        if jump_change is not None and self._law.has_friction:
            history["jump"] = history["jump"] + jump_change
        rows, commits = self.history.packed(history), self.committed.commits + 1
        before, kinematics = (
            self.committed.kinematics.pairs.pairing_displacement,
            self._kinematics.state(),
        )
        self.set_state(ContactState(rows, kinematics, trial.points, commits))
        is_first_update = before is None and kinematics.pairs.pairing_displacement is not None
        comm = self.history.function.function_space.mesh.comm
        if is_first_update and comm.rank == 0:
            logger.info(
                "%s: opposite points are those of the deformed bodies from this increment on",
                self._name,
            )

    def set_state(self, state: ContactState) -> None:
        """Make a state the committed one, and restore it. Collective."""
        self.committed = state
        self.restore()

    def check_unchanged(self, state: ContactState) -> None:
        """Raise a ValueError if another state has been committed since ``state``."""
        if self.committed.commits != state.commits:
            raise ValueError(
                f"{self._name}: its history was committed by another problem or by "
                "Contact.commit() since this problem's last commit, so that this problem cannot "
                "continue; create a new ContactProblem with these contacts and the present u"
            )

    def restore(self, trial: ContactTrial | None = None) -> None:
        """Restore history, multipliers, pairs and results of the last commit. Collective.

        The results are not evaluated again: at the committed state the law would return stick at
        points that slipped to it. Before the first commit there are no results.

        Args:
            trial: A state solved since then, whose results are restored instead.
        """
        self.history.set_rows(self.committed.history if trial is None else trial.reference)
        if self._multipliers is not None:
            self._multipliers.restore(self.history)
        self._kinematics.set_state((trial or self.committed).kinematics)
        self._values = (trial or self.committed).points

    def load_restart(
        self, history: Array, values: Mapping[str, Array], *, updates_pairs: bool
    ) -> None:
        """Commit a state of another run, whose ``u`` and loads are set. Collective.

        Args:
            history: `PointFields.rows` of that run.
            values: The arrays of its `values`, which become the results.
            updates_pairs: Whether that run updates pairs at every commit.
        """
        commits = self.committed.commits + 1
        self.set_state(ContactState(history, self._kinematics.state()))

        def evaluate_now() -> PointValues:
            self.forget()
            return self.values

        unknown = np.zeros(len(self.history.rows()))
        self._kinematics.resume(values.get("depth", unknown), evaluate_now, new_pairs=updates_pairs)
        points = self.values
        shapes = {n: v.shape for n, v in points.arrays.items()}
        if {n: v.shape for n, v in values.items()} == shapes:
            points = PointValues.of(values)
        self.set_state(ContactState(history, self._kinematics.state(), points, commits))
