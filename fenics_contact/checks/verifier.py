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

# Growth of what small displacements leave out from which on it is said again.
_AGAIN = 2.0


class Verifier:
    """Looks at evaluated states of a problem.

    Attributes:
        small_displacement_tolerance: As for `ContactProblem`.

    Raises:
        ValueError: ``cross_check`` is no bool.
    """

    def __init__(
        self, full: FullSystem, motions: RigidBodyModes, *, tolerance: float, cross_check: bool
    ) -> None:
        check_bool("cross_check", cross_check)
        self.small_displacement_tolerance = tolerance
        self._full, self._motions = full, motions
        self._cross_check = CrossCheck(full.contacts) if cross_check else None
        self._contacts, self._comm = full.contacts, full.unknowns.comm
        self._obstacles = TunnellingCheck([c for c in full.contacts if c.rigid])
        self._bodies = TunnellingCheck([c for c in full.contacts if not c.rigid])
        self._warned: dict[str, float] = {}
        self._inexact: set[str] = set()
        self._few: set[tuple[str, str]] = set()
        products = np.array([motions.by_body(full, motion) for motion in motions.of_bodies])
        products = np.moveaxis(products, 0, 2)
        # A body of one node has no rotations.
        self._inverse = np.linalg.pinv(global_sum(self._comm, products), hermitian=True)

    def verify(
        self,
        system: System,
        bulk: Array,
        *,
        start: InitialForces,
        rtol: float,
        began: Array | None,
        respond: TangentSolve | None = None,
    ) -> tuple[Verdict, Forces]:
        """Recompute residual, balance and laws at evaluated contacts. Collective.

        Args:
            system: The unknowns on which the residual is looked at.
            bulk: Residual of the bulk on these.
            start: Forces at the beginning of the increment.
            rtol: Residual that passes, as a share of the forces.
            began: The state in which the increment began; None: laws, rigid obstacles and paths are
                not judged, and tractions are those evaluated last, whatever has become of the
                laws' data since.
            respond: To look at what small displacements leave out; None: it is not looked at.

        Returns:
            The verdict, and the forces at the unknowns, reactions included.
        """
        laws = began is not None
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
        # Neither forces nor moments are judged by the axes.
        parts = np.split(imbalance, [self._full.gdim], axis=1)
        unbalanced = np.max([np.linalg.norm(part, axis=1) for part in parts], axis=0)
        sums = zip(names, unbalanced, sizes[1], allowed, strict=False)
        complete = system is self._full
        # Of the opposite only what Γc meets is known before u is complete; of rigid obstacles all.
        before, tunnelling, ejected = None, {}, {}
        if began is not None:
            before = self._full.displacement_at(began)
            tunnelling = self._obstacles.evaluate(before)
            if complete:
                ejected = find_ejected_bodies(self._full, self._motions, contacts, began, start)
        if complete:
            tunnelling |= self._bodies.evaluate(before)
        verdict = Verdict(
            equations={name: ForceBalance(*map(float, row)) for name, *row in equations},
            sums={name: ForceBalance(*map(float, row)) for name, *row in sums},
            laws={c.name: check_laws(c) for c in self._contacts} if laws else {},
            enforcement={c.name: c.enforcement_error() for c in augmented},
            enforcement_tolerance={c.name: c.tolerance for c in augmented},
            obstacles={c.name: ObstacleCheck.of(c) for c in self._contacts if laws and c.rigid},
            tunnelling=tunnelling,
            small_displacement_error=(
                estimate_small_displacement_error(self._contacts, self._full.scales, respond)
                if respond
                else {}
            ),
            small_displacement_tolerance=self.small_displacement_tolerance,
            deformation=self._deformation(),
            ejected_bodies=ejected,
            inverted=self._full.bulk.is_inverted(),
            cross_check=self._cross_check.compare() if self._cross_check and laws else {},
        )
        return verdict, system.forces(bulk, reaction)

    def warn_of_large_motion(self, verdict: Verdict) -> None:
        """Say that displacements are not small, and again where twice as much. Collective."""
        for name, found in verdict.small_displacement_error.items():
            if found.is_notable and found.worst > _AGAIN * self._warned.get(name, 0.0):
                self._warned[name] = found.worst
                warn(
                    self._comm,
                    f"{name}: displacements are assumed small, with gap and normals of the "
                    f"undeformed body; at the deformed position {found.describe()}. With large "
                    'displacements use Contact(kinematics="finite")',
                )

    def warn_of_round_off(self, verdict: Verdict) -> None:
        """Say once of every body whose forces are less exact than those of contact. Collective."""
        for name, share in verdict.inexact.items():
            if name not in self._inexact:
                self._inexact.add(name)
                warn(
                    self._comm,
                    f"{name}: round-off of its displacements leaves a residual of "
                    f"{percent(share)} of the forces on it, the possible error of its stresses "
                    "and reactions; contact forces are as accurate as on the softer bodies in "
                    "contact with it. A smaller stiffness of this body reduces it",
                )

    def warn_of_few_points(self) -> None:
        """Say once of every contact where points are too few for where it is. Collective."""
        for contact in self._contacts:
            for say in (warn_of_few_points, warn_of_divided_facets):
                told = contact.name, say.__name__
                if told not in self._few and say(contact):
                    self._few.add(told)

    def _deformation(self) -> dict[str, float]:
        """Largest displacement of every body but for its rigid motion, by its size. Collective.

        By what is prescribed, where Dirichlet values of the body differ by more than its size.
        """
        full, scales, motions = self._full, self._full.scales, self._motions
        state = full.state()
        sums = global_sum(self._comm, motions.by_body(full, state))
        rigid = np.einsum("bmn,bn->bm", self._inverse, sums)
        rest = scales.largest(state - motions.field(rigid))
        spread: Array = np.zeros(len(rigid))
        for along in motions.of_bodies[: full.gdim]:
            held = (along != 0.0) & full.constrained
            spread = np.maximum(spread, scales.spread(state, held))
        found = rest / np.maximum(scales.size, spread)
        return dict(zip(full.parts.names, found.tolist(), strict=False))

    def _force_sums(
        self, system: System, internal: Array, forces: Sequence[Array]
    ) -> tuple[Array, Array]:
        """What does not cancel of ∑F(u) - reactions - ∫ (r_n n + τ) on every body. Collective.

        Moments, too. The last is the contacts' own sum over their points, not that of their nodal
        forces.

        Args:
            system: The unknowns.
            internal: Residual of the bulk without reactions, (n_local,).
            forces: What tells how large all forces are, (n_local,) each.

        Returns:
            The sums, (n_bodies, n_per_body) (force), see `RigidBodyModes.work`; of every body the
            number of its unknowns, and the sum of the absolute forces, (2, n_bodies).
        """
        total = self._motions.by_body(system, internal)
        n = len(total)
        for operator in self._full.operators:
            contact = operator.contact
            total -= self._motions.work(operator, contact.measure[:, None] * contact.traction)
        count = np.bincount(system.label, minlength=n)[:n]
        sizes = [np.bincount(system.label, np.abs(f), minlength=n)[:n] for f in forces]
        sums = global_sum(self._comm, np.stack([*total.T, count, np.sum(sizes, axis=0)]))
        # What cannot be told is left out; a force that is no number is seen by the translations.
        rotations = sums[self._full.gdim : -2]
        rotations[np.isnan(rotations)] = 0.0
        return sums[:-2].T, sums[-2:]
