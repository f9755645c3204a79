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


# Work, as a share of the energies that there are, that is within the solver's tolerance.
_NOTHING = 1e-8


@dataclass(frozen=True)
class Energy:
    """Energy balance of an increment (force times length; in 2D per thickness), on every rank.

    Works are products of the mean force at both ends of the increment and the displacement between
    them. The loads are F at u = 0, and internal forces the rest of F. In a form with inertia both
    contain a part of the inertial forces, so that ``work`` and ``elastic`` are neither the work of
    the loads nor the elastic energy; their difference and all other attributes remain valid.

    Attributes:
        work: Work of the loads, of Dirichlet values and of moving obstacles.
        elastic: Work of the internal forces: the change of elastic energy, exact for a linear bulk.
        springs: Change of the energy in the contact springs, r_n²/2k_n + |τ|²/2k_t.
        dissipation: Frictional dissipation, ≥ 0.
        remainder: work - elastic - springs - dissipation: due to contact that changes within the
            increment, which decreases with its size, and to springs released where contact opens.
        friction: Work of friction on the body over the slip, by the mean of the tractions at both
            ends: negative where friction brakes. It is positive if slip reverses within a long
            increment, or if the state is not reached by smaller increments.
        sliding: Upper bound of the frictional work, by magnitudes of tractions and slip.
        imbalance: Work minus elastic minus the work of the tractions on Γc, which vanishes by
            equilibrium at both ends up to the solver's tolerance. Between bodies whose opposite
            points change (finite kinematics, or sliding) it only decreases with the increment size.
        friction_energy_gain: Energy that friction has supplied, relative to the energy exchanged,
            the largest over groups of interacting bodies; 0 if none. Where works cancel in a
            reversal within one increment, it is relative to ``sliding``.
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
        forces: Forces at the unknowns, by the coordinate_id of their coordinates.
        contacts: For each contact, tractions on the body, displacement relative to the obstacle,
            and prescribed displacement of the obstacle, (3, n_points, gdim). If the obstacle
            rotates: tractions, displacement relative to the obstacle in its frame, displacement of
            the body minus the unknown motion of the obstacle, and the axes of the frame,
            (3 + gdim, n_points, gdim); with a given moment also
            `ContactKinematics.turning_rate` and the angle.
        springs: For each contact, the energy in the contact springs at the points, (n_points,).
    """

    forces: dict[Any, Forces]
    contacts: list[Array]
    springs: list[Array]

    @classmethod
    def unloaded(cls, forces: dict[Any, Forces], contacts: Sequence[Contact]) -> EnergyState:
        """Return the state of contacts without tractions."""
        springs: list[Array] = [np.zeros(len(c.points)) for c in contacts]
        return cls(forces, [_ways(c, 0 * c.points) for c in contacts], springs)

    @classmethod
    def at(cls, forces: dict[Any, Forces], contacts: Sequence[Contact]) -> EnergyState:
        """Return the evaluated state of contacts."""
        springs = [np.asarray(c.measure * c.values.stored) for c in contacts]
        return cls(forces, [_ways(c, c.traction) for c in contacts], springs)

    def with_forces(self, coordinate_id: Any, forces: Forces) -> EnergyState:
        """Return this state with the forces in other coordinates, too."""
        return dataclasses.replace(self, forces={**self.forces, coordinate_id: forces})

    def between(self, contacts: Sequence[Contact]) -> EnergyState:
        """Return this state, the committed one, with relative displacements of the new pairs."""
        ways = [
            np.stack([way[0], contact.contact_kinematics.committed_jump, *way[2:]])
            for way, contact in zip(self.contacts, contacts, strict=True)
        ]
        return dataclasses.replace(self, contacts=ways)

    def since(
        self, before: EnergyState, contacts: Sequence[Contact], scales: ReferenceScales
    ) -> Energy:
        """Return the energies between the state ``before`` and this one. Collective."""
        coordinate_id = next(
            coordinate_id for coordinate_id in self.forces if coordinate_id in before.forces
        )
        old, new = before.forces[coordinate_id], self.forces[coordinate_id]
        way = new.unknowns - old.unknowns
        groups = scales.group[new.label]
        # Work, elastic, springs, dissipation, work of the tractions, that of friction, its size,
        # and the level of all: by group.
        sums: Array = np.zeros((8, scales.n_groups))

        def add(row: int, values: Array, groups: Index) -> None:
            sums[row] += np.bincount(groups, values, minlength=scales.n_groups)

        add(7, np.abs(new.internal * new.unknowns), groups)
        add(0, 0.5 * (old.external + new.external) * way, groups)
        add(1, 0.5 * (old.internal + new.internal) * way, groups)
        states = zip(
            contacts, before.contacts, self.contacts, before.springs, self.springs, strict=True
        )
        for number, (contact, there, here, had, has) in enumerate(states):
            groups = scales.group_of_points(number)
            add(7, has, groups)
            add(2, has - had, groups)
            mean = contact.measure[:, None] * 0.5 * (there[0] + here[0])
            relative, carried = here[1] - there[1], here[2] - there[2]
            if contact.contact_kinematics.turns:
                # Half-way between both ends, else a normal pressure works on what turns beneath it.
                d = here.shape[2]
                axes = 0.5 * (there[3 : 3 + d] + here[3 : 3 + d])
                relative = np.einsum("jqi,qj->qi", axes, relative)
                carried = carried - relative
                if contact.free_angle is not None:
                    # The work of the moment is that of the loads, too.
                    turned = here[-1] - there[-1]
                    moments = 0.5 * (there[0] * there[-2] + here[0] * here[-2])
                    add(0, -contact.measure * np.sum(moments * turned, axis=1), groups)
            add(0, _dot(mean, carried), groups)
            add(4, -_dot(mean, relative), groups)
            if contact.law.has_friction:
                add(3, contact.measure * contact.values.dissipated, groups)
                # Tractions before are those of the commit, not multipliers in their place.
                slip, normal = contact.slip_vector(), contact.values.normal
                first = contact.values.carried_traction if contact.finite else there[0]
                ends = np.stack([first, here[0]])
                sizes = contact.measure * np.linalg.norm(ends, axis=2).max(axis=0)
                # Forces that are round-off may have any direction.
                acts = sizes > scales.round_off_at_points(number, sizes)
                weight, length = 0.5 * contact.measure * acts, np.sqrt(_dot(slip, slip))
                for traction in ends:
                    side = traction - _dot(traction, normal)[:, None] * normal
                    add(5, weight * _dot(side, slip), groups)
                    add(6, weight * (np.sqrt(_dot(side, side)) * length), groups)
        sums = scales.global_sum(sums)
        # Nothing has slipped but what the solver leaves.
        sums[5, np.abs(sums[5]) <= _NOTHING * sums[7]] = 0.0
        work, elastic, springs, dissipation, tractions, friction, sliding, _ = map(
            float, sums.sum(axis=1)
        )
        exchanged = np.maximum(np.abs(sums[:3]).sum(axis=0), sums[6])
        gives = sums[5] > 0
        return Energy(
            work=work,
            elastic=elastic,
            springs=springs,
            dissipation=dissipation,
            remainder=work - elastic - springs - dissipation,
            friction=friction,
            sliding=sliding,
            imbalance=work - elastic - tractions,
            friction_energy_gain=float((sums[5, gives] / exchanged[gives]).max(initial=0.0)),
        )


def _ways(contact: Contact, traction: Array) -> Array:
    """A contact's part of `EnergyState.contacts`."""
    jump = contact.values.jump
    if not contact.contact_kinematics.turns:
        return np.stack([traction, jump, contact.values.shift])
    units = np.eye(jump.shape[1])
    axes = [contact.contact_kinematics.turned(np.broadcast_to(unit, jump.shape)) for unit in units]
    # The work of forces that move the obstacle is that of the loads.
    own = contact.own_displacement()
    for component, motion in contact.free_motion.items():
        own[:, component] -= float(motion.value)
    ways = [traction, jump, own, *axes]
    if contact.free_angle is not None:
        angle = float(contact.free_angle.value)
        ways += [contact.contact_kinematics.turning_rate(), np.full_like(jump, angle)]
    return np.stack(ways)


def _dot(one: Array, other: Array) -> Array:
    """Products of vectors at points, (n_points,)."""
    return np.asarray(np.einsum("qi,qi->q", one, other), dtype=np.float64)
