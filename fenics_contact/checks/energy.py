"""Energy balance of an increment: work of loads, elastic energy, contact springs, friction."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fenics_contact.contact.contact import Contact
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.types import Array, Index

__all__ = ["Energy", "EnergyState"]


# Work of friction within the solver's tolerance, relative to the energies of the group of bodies.
_NEGLIGIBLE_WORK_RATIO = 1e-8


@dataclass(frozen=True)
class Energy:
    """Energy balance of an increment (force times length; in 2D per thickness), on every rank.

    Works are products of the mean force at both ends of the increment and the displacement between
    them. The loads are F at u = 0, and internal forces the rest of F. In a form with inertia both
    have a part of the inertial forces; the difference of ``work`` and ``elastic`` remains valid.

    Attributes:
        work: Work of the loads, of Dirichlet values and of moving obstacles.
        elastic: Work of the internal forces: the change of elastic energy, exact for a linear bulk.
        springs: Change of the energy in the contact springs, r_n²/2k_n + |τ|²/2k_t.
        dissipation: Frictional dissipation, ≥ 0.
        remainder: work - elastic - springs - dissipation: due to contact that changes within the
            increment, which decreases with its size, and to springs released where contact opens.
        friction: Work of friction on the body over the slip, by the mean of the tractions at both
            ends, normally negative. It is positive if slip reverses within a long increment, or if
            the state is not reached by smaller increments.
        sliding: Upper bound of the frictional work, by magnitudes of tractions and slip.
        imbalance: Work minus elastic minus the work of the tractions on Γc, zero by equilibrium at
            both ends. If opposite points change, it decreases with the increment size.
        friction_energy_gain: Energy supplied by friction relative to the energy exchanged, or to
            ``sliding`` if works cancel: the largest over groups of interacting bodies.
    """

    work: float
    elastic: float
    springs: float
    dissipation: float
    remainder: float
    friction: float
    sliding: float
    imbalance: float
    friction_energy_gain: float


@dataclass(frozen=True)
class EnergyState:
    """Forces and displacements of a state on this rank; two states determine an `Energy`.

    Attributes:
        forces: Forces at the unknowns, by `System.coordinate_id`.
        contacts: For each contact, tractions on the body, displacement relative to the obstacle,
            and prescribed displacement of the obstacle, (3, n_points, gdim). If the obstacle
            rotates: tractions, displacement relative to the obstacle in its frame, displacement of
            the body minus the unknown motion of the obstacle, and the axes of the frame,
            (3 + gdim, n_points, gdim); with a given moment also
            `ContactKinematics.rotation_derivative` and the angle.
        springs: For each contact, the energy in the contact springs at the points, (n_points,).
    """

    forces: dict[Any, Forces]
    contacts: list[Array]
    springs: list[Array]

    @classmethod
    def unloaded(cls, forces: dict[Any, Forces], contacts: Sequence[Contact]) -> EnergyState:
        """Return the state of contacts without tractions."""
        springs: list[Array] = [np.zeros(len(c.points)) for c in contacts]
        return cls(forces, [_contact_rows(c, 0 * c.points) for c in contacts], springs)

    @classmethod
    def at(cls, forces: dict[Any, Forces], contacts: Sequence[Contact]) -> EnergyState:
        """Return the evaluated state of contacts."""
        springs = [np.asarray(c.measure * c.values.stored) for c in contacts]
        return cls(forces, [_contact_rows(c, c.traction) for c in contacts], springs)

    def with_forces(self, coordinate_id: Any, forces: Forces) -> EnergyState:
        """Return this state with the forces in additional coordinates."""
        return dataclasses.replace(self, forces={**self.forces, coordinate_id: forces})

    def with_committed_jumps(self, contacts: Sequence[Contact]) -> EnergyState:
        """Return this committed state with the committed jumps of the contacts' present pairs."""
        rows = [
            np.stack([row[0], contact.contact_kinematics.committed_jump, *row[2:]])
            for row, contact in zip(self.contacts, contacts, strict=True)
        ]
        return dataclasses.replace(self, contacts=rows)

    def compute_energy(
        self, before: EnergyState, contacts: Sequence[Contact], scales: ReferenceScales
    ) -> Energy:
        """Return the energies between the state ``before`` and this one. Collective."""
        shared_id = next(coordinates for coordinates in self.forces if coordinates in before.forces)
        old, new = before.forces[shared_id], self.forces[shared_id]
        displacement = new.unknowns - old.unknowns
        # By group: work, elastic, springs, dissipation, work of the tractions, work of friction,
        # bound of the work of friction, magnitude of the energies.
        sums: Array = np.zeros((8, scales.n_groups))

        def add(row: int, values: Array, groups: Index) -> None:
            sums[row] += np.bincount(groups, values, minlength=scales.n_groups)

        parts = new.partition
        add(7, parts.absolute_sums(new.internal * new.unknowns), scales.group)
        add(0, 0.5 * parts.products(old.external + new.external, displacement), scales.group)
        add(1, 0.5 * parts.products(old.internal + new.internal, displacement), scales.group)
        states = zip(
            contacts, before.contacts, self.contacts, before.springs, self.springs, strict=True
        )
        for number, (contact, start, end, springs_start, springs_end) in enumerate(states):
            groups = scales.group_of_points(number)
            add(7, springs_end, groups)
            add(2, springs_end - springs_start, groups)
            mean = contact.measure[:, None] * 0.5 * (start[0] + end[0])
            relative, obstacle = end[1] - start[1], end[2] - start[2]
            if contact.contact_kinematics.has_rotation:
                # With the mean of the axes, normal pressure does no work on a rotating obstacle.
                d = end.shape[2]
                axes = 0.5 * (start[3 : 3 + d] + end[3 : 3 + d])
                relative = np.einsum("jqi,qj->qi", axes, relative)
                obstacle = obstacle - relative
                if contact.free_angle is not None:
                    # The moment is one of the loads, which include its work already.
                    rotation = end[-1] - start[-1]
                    moments = 0.5 * (start[0] * start[-2] + end[0] * end[-2])
                    add(0, -contact.measure * np.sum(moments * rotation, axis=1), groups)
            add(0, _dot(mean, obstacle), groups)
            add(4, -_dot(mean, relative), groups)
            if contact.law.has_friction:
                add(3, contact.measure * contact.values.dissipated, groups)
                # At the start the committed tractions, not the multipliers that replace them.
                slip, normal = contact.slip_vector(), contact.values.normal
                finite = contact.contact_kinematics.is_finite
                first = contact.values.carried_traction if finite else start[0]
                ends = np.stack([first, end[0]])
                sizes = contact.measure * np.linalg.norm(ends, axis=2).max(axis=0)
                # Forces below round-off may have any direction.
                acts = sizes > scales.round_off_at_points(number, sizes)
                weight, length = 0.5 * contact.measure * acts, np.sqrt(_dot(slip, slip))
                for traction in ends:
                    tangential = traction - _dot(traction, normal)[:, None] * normal
                    add(5, weight * _dot(tangential, slip), groups)
                    add(6, weight * (np.sqrt(_dot(tangential, tangential)) * length), groups)
        sums = scales.global_sum(sums)
        sums[5, np.abs(sums[5]) <= _NEGLIGIBLE_WORK_RATIO * sums[7]] = 0.0
        work, elastic, springs, dissipation, tractions, friction, sliding, _ = map(
            float, sums.sum(axis=1)
        )
        exchanged = np.maximum(np.abs(sums[:3]).sum(axis=0), sums[6])
        gains = sums[5] > 0
        return Energy(
            work=work,
            elastic=elastic,
            springs=springs,
            dissipation=dissipation,
            remainder=work - elastic - springs - dissipation,
            friction=friction,
            sliding=sliding,
            imbalance=work - elastic - tractions,
            friction_energy_gain=float((sums[5, gains] / exchanged[gains]).max(initial=0.0)),
        )


def _contact_rows(contact: Contact, traction: Array) -> Array:
    """Return the rows of `EnergyState.contacts` of one contact."""
    jump = contact.values.jump
    if not contact.contact_kinematics.has_rotation:
        return np.stack([traction, jump, contact.values.shift])
    units = np.eye(jump.shape[1])
    axes = [contact.contact_kinematics.rotate(np.broadcast_to(unit, jump.shape)) for unit in units]
    # Forces on the obstacle are loads, which include their work already.
    own = contact.pairs.own_displacement()
    for component, motion in contact.free_motion.items():
        own[:, component] -= float(motion.value)
    rows = [traction, jump, own, *axes]
    if contact.free_angle is not None:
        angle = float(contact.free_angle.value)
        rows += [contact.contact_kinematics.rotation_derivative(), np.full_like(jump, angle)]
    return np.stack(rows)


def _dot(one: Array, other: Array) -> Array:
    """Return the scalar products of vectors at the points, (n_points,)."""
    return np.asarray(np.einsum("qi,qi->q", one, other), dtype=np.float64)
