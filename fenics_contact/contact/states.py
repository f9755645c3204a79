"""The states of a contact: committed, solved and not committed, and evaluated at the present u."""

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
        history: Committed tractions, slip and slip reference, and multipliers: `PointFields.rows`.
        opposite: Committed place of the obstacle, and the pairs.
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
        reference: The history that the increment started from, with the slip reference of bodies
            that were positioned: `PointFields.rows`.
        opposite: Committed place of the obstacle, and the pairs of this state, between which it is
            measured.
    """

    points: PointValues
    history: Mapping[str, Array]
    reference: Array
    kinematics: KinematicsState


class ContactStates:
    """The committed state of a contact, and what is evaluated from it at the present ``u``.

    It begins at the ``u`` at construction, which is collective.

    Attributes:
        committed: The committed state.
        history: Its history variables, of which an increment may count slip from elsewhere.
    """

    def __init__(
        self,
        parts: ContactParts,
        multipliers: Multipliers | None,
        opposite: ContactKinematics,
        acting: EffectiveLaw,
    ) -> None:
        self.history = history = parts.history
        self._name, self._law, self._multipliers = parts.name, parts.law, multipliers
        self._opposite, self._effective_law = opposite, acting
        self._values: PointValues | None = None
        opposite.reset_reference()
        self.committed = ContactState(history.rows(), opposite.state())
        self._start()

    @property
    def values(self) -> PointValues:
        """All fields of the last evaluation at this rank's points."""
        if self._values is None:
            self.evaluate()
            assert self._values is not None
        return self._values

    def evaluate(self) -> None:
        """Evaluate gap, tractions and slip at the present ``u``. Collective.

        The history is not changed.
        """
        self._values = self.evaluate_present()

    def evaluate_present(self) -> PointValues:
        """Evaluate them without a change of `values`. Collective."""
        self._opposite.update()
        arrays = {**self._opposite.data.values, **self._effective_law.own.evaluate()}
        return PointValues.of(arrays | self._opposite.outputs(arrays))

    def forget(self) -> None:
        """Discard the last evaluation: the next access to a result evaluates the present ``u``."""
        self._values = None

    def begin(self) -> None:
        """Measure slip from the present ``u`` if nothing has been committed yet. Collective.

        The obstacle is taken in its initial position. The constructor does so with the ``u`` at
        construction, and `ContactProblem` again before its first increment.
        """
        if not self.committed.commits and self._opposite.reset_reference():
            self._start()

    def _start(self) -> None:
        """Make the present ``u`` the state before the first increment. Collective."""
        if self._law.has_friction:
            start = {name: self.history.values(name) for name in self.history.names}
            self.history.assign(start | self._opposite.reference_fields())
        self.set_state(ContactState(self.history.rows(), self._opposite.state()))

    def begin_between(self, opposite: KinematicsState) -> None:
        """Count an increment from its start between other pairs; `restore` undoes it. Collective.

        Args:
            opposite: The pairs, with the jump between them in the committed state.
        """
        moved = opposite.jump - self._opposite.committed_jump
        self._opposite.set_state(opposite)
        if self._law.has_friction:
            kept = {name: self.history.values(name) for name in self.history.names}
            self.history.assign(kept | {"jump": kept["jump"] + moved})
        self.forget()

    def set_slip_reference(self, points: Mask) -> None:
        """Measure slip from the state evaluated last where points were unloaded. Collective.

        `restore` undoes it.

        Args:
            points: Mask of the points, (n_points,); those that were loaded slip from where they
                did.
        """
        if not self._law.has_friction:
            return
        points = points & (self.history.values("normal_traction") == 0.0)
        kept = {name: self.history.values(name) for name in self.history.names}
        slip_reference = self._opposite.slip_reference(self.values)
        counted = {n: np.where(points[:, None], v, kept[n]) for n, v in slip_reference.items()}
        self.history.assign(kept | counted)
        self.forget()

    def trial(self, *, is_loaded: bool = True) -> ContactTrial:
        """Return a copy of the evaluated state, for `commit`.

        Args:
            is_loaded: Whether there is a contact force (`ForceBalance.is_loaded`). Without one all
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
        history = self._opposite.to_history(values)
        return ContactTrial(points, history, self.history.rows(), self._opposite.state())

    def commit(self, trial: ContactTrial | None = None) -> None:
        """Make a solved state the history of the next increment. Collective.

        Args:
            trial: A state returned by `trial`; by default the state at the present ``u``.
        """
        if trial is None:
            self.evaluate()
            trial = self.trial()
        # Results stay those of the solution, whatever its pairs.
        moved = self._opposite.commit(trial.points)
        history = dict(trial.history)
        if moved is not None and self._law.has_friction:
            history["jump"] = history["jump"] + moved
        rows, commits = self.history.packed(history), self.committed.commits + 1
        before, opposite = self.committed.kinematics.pairs.found_at, self._opposite.state()
        self.set_state(ContactState(rows, opposite, trial.points, commits))
        replaced = before is None and opposite.pairs.found_at is not None
        comm = self.history.function.function_space.mesh.comm
        if replaced and comm.rank == 0:
            logger.info(
                "%s: opposite points are those of the deformed bodies from this increment on",
                self._name,
            )

    def set_state(self, state: ContactState) -> None:
        """Make a state the committed one, and the present one. Collective."""
        self.committed = state
        self.restore()

    def restore(self, trial: ContactTrial | None = None) -> None:
        """Restore history, multipliers, pairs and results of the last commit. Collective.

        The results are restored, not evaluated again: at the committed state the law would return
        stick at points that slipped to it. Before the first commit there are no results.

        Args:
            trial: A state solved since then, whose results are restored instead.
        """
        self.history.set_rows(self.committed.history if trial is None else trial.reference)
        if self._multipliers is not None:
            self._multipliers.restore(self.history)
        self._opposite.set_state((trial or self.committed).kinematics)
        self._values = (trial or self.committed).points

    def load_restart(self, history: Array, values: Mapping[str, Array], *, anew: bool) -> None:
        """Make a state of another run the committed one. Collective.

        ``u`` and the loads must be those of that run.

        Args:
            history: `PointFields.rows` of that run.
            values: The arrays of its `values`, which become the results.
            anew: Whether pairs are found again at every commit of that run.
        """
        commits = self.committed.commits + 1
        self.set_state(ContactState(history, self._opposite.state()))

        def present() -> PointValues:
            self.forget()
            return self.values

        unknown = np.zeros(len(self.history.rows()))
        self._opposite.resume(values.get("depth", unknown), present, new_pairs=anew)
        points = self.values
        shapes = {n: v.shape for n, v in points.arrays.items()}
        if {n: v.shape for n, v in values.items()} == shapes:
            points = PointValues.of(values)
        self.set_state(ContactState(history, self._opposite.state(), points, commits))
