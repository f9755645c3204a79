"""Verification of a solution, independent of the method that found it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.arguments import check_bool
from fenics_contact.checks.cross_check import CrossCheck
from fenics_contact.checks.kinematics import TangentSolve, estimate_small_displacement_error
from fenics_contact.checks.obstacles import ObstacleCheck
from fenics_contact.checks.quadrature_resolution import warn_of_divided_facets, warn_of_few_points
from fenics_contact.checks.tunnelling import TunnellingCheck
from fenics_contact.checks.verdict import ForceBalance, Verdict, check_laws
from fenics_contact.parallel import global_sum, warn
from fenics_contact.systems.balance import InitialForces
from fenics_contact.systems.ejected_bodies import find_ejected_bodies
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.systems.system import System
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array
from fenics_contact.wording import percent

__all__ = ["Verifier"]

# Growth of the small-displacement error after which the warning is repeated.
_REPEATED_WARNING_FACTOR = 2.0


class Verifier:
    """Verification of evaluated states of a problem.

    Attributes:
        small_displacement_tolerance: Largest relative error accepted of forces and pressures.

    Raises:
        ValueError: ``cross_check`` is not a bool.
    """

    def __init__(
        self, full: FullSystem, motions: RigidBodyModes, *, tolerance: float, cross_check: bool
    ) -> None:
        check_bool("cross_check", cross_check)
        self.small_displacement_tolerance = tolerance
        self._full, self._motions = full, motions
        self._cross_check = CrossCheck(full.contacts) if cross_check else None
        self._contacts, self._comm = full.contacts, full.unknowns.comm
        self._rigid = rigid = [c for c in full.contacts if c.contact_kinematics.is_rigid]
        self._obstacles = TunnellingCheck(rigid)
        self._bodies = TunnellingCheck([c for c in full.contacts if c not in rigid])
        self._warned_errors: dict[str, float] = {}
        self._warned_round_off: set[str] = set()
        self._warned_resolution: set[tuple[str, str]] = set()
        # Numbers of the prescribed displacements along each axis.
        translations = motions.of_bodies[: full.gdim] != 0.0
        self._prescribed = [np.flatnonzero(moved & full.constrained) for moved in translations]
        # The pseudo-inverse serves bodies of one node, without rotations.
        self._inverse = np.linalg.pinv(motions.gram_by_body(), hermitian=True)

    def verify(
        self,
        system: System,
        bulk: Array,
        *,
        start: InitialForces,
        rtol: float,
        initial_unknowns: Array | None,
        respond: TangentSolve | None = None,
    ) -> tuple[Verdict, Forces]:
        """Recompute residual, balance and laws at evaluated contacts. Collective.

        Args:
            system: The system of the unknowns.
            bulk: Residual of the bulk (force).
            start: Forces at the beginning of the increment.
            rtol: Residual accepted, relative to the forces.
            initial_unknowns: Unknowns at the beginning; None: laws, rigid obstacles and paths are
                not verified, and tractions are those evaluated last.
            respond: Solves with the tangent for the small-displacement error; None: the error is
                not estimated.

        Returns:
            The verdict, and the forces at the unknowns, with reactions.
        """
        laws = initial_unknowns is not None
        contacts = system.contact_forces(evaluated=not laws)
        total = sum(contacts, bulk)
        norms = system.norms(total, contacts, start)
        names, tolerance = system.parts.names, norms.tolerance(rtol)
        reaction = np.where(system.constrained, total, 0.0)
        imbalance, sizes = self._force_sums(system, bulk - reaction, [bulk, *contacts])
        allowed = np.sqrt(sizes[0]) * 2 * tolerance[: len(imbalance)] + ROUND_OFF * sizes[1]
        augmented = [c for c in self._contacts if c.multipliers is not None and laws]
        rows = norms.residual, norms.force, tolerance, norms.round_off
        equations = zip(names, *rows, strict=True)
        # The norms of forces and of moments do not depend on the axes.
        parts = np.split(imbalance, [self._full.gdim], axis=1)
        unbalanced = np.max([np.linalg.norm(part, axis=1) for part in parts], axis=0)
        sums = zip(names, unbalanced, sizes[1], allowed, strict=False)
        complete = system is self._full
        # Opposing bodies are known on the retained dofs only, unless u is complete.
        before, tunnelling, ejected = None, {}, {}
        if initial_unknowns is not None:
            before = self._full.displacement_at(initial_unknowns)
            tunnelling = self._obstacles.evaluate(before)
            if complete:
                ejected = find_ejected_bodies(
                    self._full, self._motions, contacts, initial_unknowns, start
                )
        if complete:
            tunnelling |= self._bodies.evaluate(before)
        verdict = Verdict(
            equations={name: ForceBalance(*map(float, row)) for name, *row in equations},
            sums={name: ForceBalance(*map(float, row)) for name, *row in sums},
            laws={c.name: check_laws(c) for c in self._contacts} if laws else {},
            enforcement={c.name: c.enforcement_error() for c in augmented},
            enforcement_tolerance={c.name: c.tolerance for c in augmented},
            obstacles={c.name: ObstacleCheck.of(c) for c in self._rigid if laws},
            tunnelling=tunnelling,
            small_displacement_error=(
                estimate_small_displacement_error(self._contacts, self._full.scales, respond)
                if respond
                else {}
            ),
            small_displacement_tolerance=self.small_displacement_tolerance,
            deformation=self._deformation() if complete else {},
            ejected_bodies=ejected,
            inverted=self._full.bulk.is_inverted(),
            cross_check=self._cross_check.compare() if self._cross_check and laws else {},
        )
        return verdict, system.forces(bulk, reaction)

    def warn_of_large_motion(self, verdict: Verdict) -> None:
        """Warn of a small-displacement error, and again if it has doubled. Collective."""
        for name, error in verdict.small_displacement_error.items():
            threshold = _REPEATED_WARNING_FACTOR * self._warned_errors.get(name, 0.0)
            if error.is_notable and error.worst > threshold:
                self._warned_errors[name] = error.worst
                warn(
                    self._comm,
                    f"{name}: displacements are assumed small, with gap and normals of the "
                    f"undeformed body; at the deformed position {error.describe()}. With large "
                    'displacements use Contact(kinematics="finite")',
                )

    def warn_of_round_off(self, verdict: Verdict) -> None:
        """Warn once of every body with a large round-off of its forces. Collective."""
        for name, residual in verdict.inexact.items():
            if name not in self._warned_round_off:
                self._warned_round_off.add(name)
                warn(
                    self._comm,
                    f"{name}: round-off of its displacements leaves a residual of "
                    f"{percent(residual)} of the forces on it, the possible error of its stresses "
                    "and reactions; contact forces are as accurate as on the softer bodies in "
                    "contact with it. A smaller stiffness of this body reduces it",
                )

    def warn_of_few_points(self) -> None:
        """Warn once of every contact with too few quadrature points. Collective."""
        for contact in self._contacts:
            for warn_of in (warn_of_few_points, warn_of_divided_facets):
                key = contact.name, warn_of.__name__
                if key not in self._warned_resolution and warn_of(contact):
                    self._warned_resolution.add(key)

    def _deformation(self) -> dict[str, float]:
        """Return the `Verdict.deformation` of every body. Collective."""
        full, scales, motions = self._full, self._full.scales, self._motions
        state = full.state()
        sums = global_sum(self._comm, motions.by_body(state))
        rigid = np.einsum("bmn,bn->bm", self._inverse, sums)
        deformation = scales.largest(state - motions.field(rigid))
        spread: Array = np.zeros(len(rigid))
        for prescribed in self._prescribed:
            spread = np.maximum(spread, scales.spread(state, prescribed))
        ratios = deformation / np.maximum(scales.size, spread)
        return dict(zip(full.parts.names, ratios.tolist(), strict=False))

    def _force_sums(
        self, system: System, internal: Array, forces: Sequence[Array]
    ) -> tuple[Array, Array]:
        """Sum forces and moments ∑F(u) - reactions - ∫ (r_n n + τ) by body. Collective.

        The integral is the sum over the quadrature points, not over nodal forces.

        ``internal`` is the residual of the bulk without reactions, (n_local,).

        Returns:
            The sums, (n_bodies, n_per_body) (force), as of `RigidBodyModes.work`; the number of
            unknowns and the sum of the absolute ``forces`` of every body, (2, n_bodies).
        """
        total = self._motions.by_body_on(system, internal)
        n = len(total)
        for operator in self._full.operators:
            contact = operator.contact
            total -= self._motions.work(operator, contact.measure[:, None] * contact.traction)
        sizes = np.sum([system.partition.absolute_sums(force) for force in forces], axis=0)
        sums = np.stack([*total.T, system.partition.sizes[:n], sizes[:n]])
        sums = global_sum(self._comm, sums)
        # Moments that are NaN are omitted: a NaN force is found in the translations.
        rotations = sums[self._full.gdim : -2]
        rotations[np.isnan(rotations)] = 0.0
        return sums[:-2].T, sums[-2:]
