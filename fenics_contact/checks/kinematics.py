"""Error of the small-displacement assumption: gap and normal at the deformed position.

The gap is s - u_n with s and n of the undeformed body, eq. (1). The change of the contact forces
with s and n at X + u follows from one linear solve with the present tangent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fenics_contact.checks.condition import Condition
from fenics_contact.contact.body import NEGLIGIBLE_SLIDE
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import global_mean, global_min, global_sum, max_norm
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Mask
from fenics_contact.wording import percent

__all__ = [
    "Deviation",
    "SmallDisplacementError",
    "TangentSolve",
    "estimate_small_displacement_error",
    "spring_stiffness",
    "traction_change",
]

# Function of the stiffness and of the tractions added at the points of every contact, that returns
# the change of the jumps there.
TangentSolve = Callable[[Sequence[Array], Sequence[Array]], Sequence[Array]]
# Mask of this rank's points of a contact on one group of coupled bodies, (n_points,), and whether
# their force is round-off.
_Group = tuple[Mask, bool]
# Change of the tractions, relative to the largest one, below which there is no linear solve.
_NEGLIGIBLE_CHANGE_RATIO = 1e-3
# Difference of the displacements on Γc, relative to its size, below which pairs do not change.
_NEGLIGIBLE_ROTATION_RATIO = 1e-3
# Relative error of force or pressure from which on there is a warning.
_NOTABLE_ERROR_RATIO = 0.01


def spring_stiffness(contact: Contact) -> Array:
    """Return minus the derivative of the traction by the jump, (n_points, gdim, gdim).

    The status of the points is that of the present state.
    """
    law, values, status = contact.law, contact.values, contact.status
    normal = values.normal
    d = normal.shape[1]
    stiffness = np.zeros((len(normal), d, d))
    if law.has_normal_stiffness:
        # At slipping points friction follows the bound, which depends on the pressure.
        slips = (status == Status.SLIP) & (contact.pressure > 0) & (values.friction_bound > 0)
        slope = np.where(slips, values.friction_bound_slope, 0.0)
        ratio = slope / np.where(slips, values.friction_bound, 1.0)
        direction = normal - ratio[:, None] * contact.tangential_traction
        k_n = np.where(status != Status.OPEN, contact.values.normal_stiffness, 0.0)
        stiffness += k_n[:, None, None] * np.einsum("qi,qj->qij", direction, normal)
    if law.has_tangential:
        sticks = (status == Status.STICK)[:, None, None]
        stiffness += np.where(sticks, contact.values.tangential_stiffness, 0.0)
        stiffness += _slip_rotation_stiffness(contact)
    return stiffness


def traction_change(stiffness: Array, jump: Array) -> Array:
    """Return the change of the traction due to a change of the jump, (n_points, gdim) (stress)."""
    return -np.einsum("qij,qj->qi", stiffness, jump)


def _slip_rotation_stiffness(contact: Contact) -> Array:
    """Return the stiffness due to rotation of the slip direction, (n_points, gdim, gdim).

    It is zero in the plane. Polygonal friction cones are approximated by elliptic ones.
    """
    values, d = contact.values, contact.values.normal.shape[1]
    stiffness: Array = np.zeros((len(values.normal), d, d))
    slips = contact.status == Status.SLIP
    if d == 2 or not slips.any():
        return stiffness
    traction, k_t = values.traction[slips], values.tangential_stiffness[slips]
    stretch = np.einsum("qij,qj->qi", np.linalg.pinv(k_t, hermitian=True), traction)
    energy = np.sum(traction * stretch, axis=1)
    projection = np.einsum("qi,qj->qij", traction, traction)
    projection /= np.where(energy > 0, energy, np.inf)[:, None, None]
    secant = np.where(energy > 0, values.friction_secant[slips], 0.0)
    stiffness[slips] = secant[:, None, None] * (k_t - projection)
    return stiffness


@dataclass(frozen=True)
class SmallDisplacementError:
    """Relative error of a contact due to the small-displacement assumption, on every rank.

    It is the largest error of the groups of bodies that the contact couples.

    Attributes:
        force: Error of the contact force, the magnitude of its change.
        pressure: Error of the pressure, in the L² norm over Γc.
        rough: Whether the estimate of the pressure is inaccurate, as between two meshes.
        slide: Largest distance by which points in contact have slid from the positions at which
            their forces act on the opposing body, relative to the size of their facets.
        slide_limit: Largest such distance accepted.
    """

    force: float = 0.0
    pressure: float = 0.0
    rough: bool = False
    slide: float = 0.0
    slide_limit: float = np.inf

    @property
    def worst(self) -> float:
        """The larger of the errors of force and pressure; infinite if one is not finite."""
        worst = max(self.force, self.pressure)
        return worst if np.isfinite(self.force) and np.isfinite(self.pressure) else np.inf

    @property
    def is_notable(self) -> bool:
        """Whether the error of force or pressure exceeds 1 %."""
        return self.worst > _NOTABLE_ERROR_RATIO

    def conditions(self, contact: str, tolerance: float) -> list[Condition]:
        """Return the conditions on a contact of this name, by the largest error accepted."""
        if tolerance == np.inf:
            return []
        if np.isfinite(self.verified_error):
            error = (
                "displacements are too large for the small-displacement assumption: with gap and "
                "normals of the deformed bodies, the contact force would differ by "
                f"{percent(self.force)} and the pressure by {percent(self.pressure)}, above "
                f"{percent(tolerance)}. Use smaller increments, move the obstacle instead of "
                'the body, update the pairs (update_pairs="increment"), use '
                'Contact(kinematics="finite"), or accept the error: '
                "ContactProblem(small_displacement_tolerance=inf)"
            )
        else:
            error = (
                "the small-displacement error could not be estimated, because the contact tangent "
                "leaves a rigid-body mode of a body free. If all of its points slip, the load has "
                "reached the friction limit. Constrain the body by a Dirichlet condition or a weak "
                "spring, or accept the error: ContactProblem(small_displacement_tolerance=inf)"
            )
        slide = (
            f"points have slid by {self.slide:.2g} facets from where their forces act on the "
            f"opposing body, more than {self.slide_limit:g}. Use smaller increments, "
            'update_pairs="auto" where it is "never", or Contact(kinematics="finite"), or accept '
            "the error: ContactProblem(small_displacement_tolerance=inf)"
        )
        return [
            Condition(f"{name}, {contact}", value, limit, f"{contact}: {failure}")
            for name, value, limit, failure in (
                ("small displacements", self.verified_error, tolerance, error),
                ("slide off the opposite points", self.slide, self.slide_limit, slide),
            )
        ]

    def is_due_to_pairs(self, tolerance: float) -> bool:
        """Whether updated pairs may remove a notable error."""
        notable = self.verified_error > _NOTABLE_ERROR_RATIO and self.slide > NEGLIGIBLE_SLIDE
        return notable or not all(each.holds for each in self.conditions("", tolerance))

    def describe(self) -> str:
        """Return the errors in words."""
        return (
            f"the contact force would differ by {percent(self.force)} and the pressure by "
            f"{percent(self.pressure)}"
        )

    @property
    def verified_error(self) -> float:
        """The error that is compared with the tolerance: of the force only, if ``rough``."""
        return self.force if self.rough and np.isfinite(self.worst) else self.worst


@dataclass(frozen=True)
class Deviation:
    """Difference of gap and normal in the deformed bodies from the linearised ones.

    Attributes:
        gap: Gap minus s - u_n at closed points, the gap at open points that penetrate, 0 elsewhere,
            (n_points,) (length).
        normal_change: Change of the unit normal of closed points, (n_points, gdim).
        normal: Unit normal in the deformed bodies, (n_points, gdim).
        lost: Closed points without an opposite point in the deformed bodies, (n_points,).
        closing: Open points that penetrate in the deformed bodies, (n_points,).
    """

    gap: Array
    normal_change: Array
    normal: Array
    lost: Mask
    closing: Mask

    @classmethod
    def of(cls, contact: Contact) -> Deviation:
        """Evaluate a contact; the deviation is zero where it is unknown. Collective."""
        values, closed = contact.values, contact.status != Status.OPEN
        zero, no_points = np.zeros(len(closed)), np.zeros(len(closed), dtype=np.bool_)
        exact = contact.contact_kinematics.is_finite or contact.contact_kinematics.is_flat
        if exact or not (contact.contact_kinematics.is_rigid or _has_moved(contact)):
            return cls(zero, np.zeros_like(values.normal), values.normal, no_points, no_points)
        change, normal = contact.contact_kinematics.deviation(values)
        if not contact.contact_kinematics.is_rigid:
            # It jumps from point to point; bodies respond to its smooth part on Γc.
            paired = contact.pairs.paired & ~np.isnan(change)
            smooth = contact.traces(np.where(paired, change, 0.0))
            change = np.where(paired, smooth, change)
        known = np.isfinite(normal).all(axis=1)
        normal_change = np.where((known & closed)[:, None], normal - values.normal, 0.0)
        # At the boundary of the opposing surface points keep their pairs unless they slide.
        slides = (
            np.linalg.norm(values.slide, axis=1) > NEGLIGIBLE_SLIDE * contact.quadrature.facet_sizes
        )
        lost = known & closed & slides & np.isnan(change)
        if contact.gap_prescribed:
            return cls(zero, normal_change, normal, lost, no_points)
        deformed = np.where(contact.pairs.paired, values.gap, 0.0) + change
        size = np.linalg.norm(values.x, axis=1) + contact.quadrature.facet_sizes
        tolerance = ROUND_OFF * size
        if not contact.contact_kinematics.is_rigid:
            # The deviation of closed points is due to faceting.
            tolerance += max_norm(contact.surface.mesh.comm, np.nan_to_num(change[closed]))
        closing = known & ~closed & (deformed < -tolerance)
        gap = np.where(closing, deformed, 0.0)
        gap = np.where(known & closed & ~lost, np.nan_to_num(change), gap)
        return cls(gap, normal_change, normal, lost, closing)

    def linearised(self, contact: Contact) -> tuple[Array, Array]:
        """Return stiffness and traction change at fixed displacements in the deformed bodies."""
        traction, values = contact.traction, contact.values
        k_n = np.where(self.closing, contact.values.normal_stiffness, 0.0)
        added = k_n[:, None, None] * np.einsum("qi,qj->qij", self.normal, self.normal)
        lost = self.lost[:, None]
        stiffness = np.where(lost[:, None], 0.0, spring_stiffness(contact)) + added
        rotated = values.normal_traction[:, None] * self.normal_change
        normal = np.where(self.closing[:, None], self.normal, values.normal)
        change = rotated + traction_change(stiffness, -self.gap[:, None] * normal)
        return stiffness, np.where(lost, -traction, change)


def _has_moved(contact: Contact) -> bool:
    """Whether bodies have slid or rotated by enough for other pairs. Collective."""
    comm, values = contact.surface.mesh.comm, contact.values
    smallest = global_min(comm, contact.quadrature.facet_sizes, empty=np.inf)
    x, u = values.x, contact.pairs.own_displacement()
    # A point without a pair may find one wherever it moves.
    slide = max_norm(comm, np.where(contact.pairs.paired[:, None], values.slide, u))
    size = max(max_norm(comm, x - global_mean(comm, x)), 1e-300)
    rotation = max_norm(comm, u - global_mean(comm, u)) / size
    return not (slide <= NEGLIGIBLE_SLIDE * smallest and rotation <= _NEGLIGIBLE_ROTATION_RATIO)


def estimate_small_displacement_error(
    contacts: Sequence[Contact], scales: ReferenceScales, respond: TangentSolve
) -> dict[str, SmallDisplacementError]:
    """Estimate the error of the small-displacement assumption, by contact. Collective.

    Errors are relative to the force of the group of bodies. The contacts are evaluated.
    """
    deviations = [Deviation.of(c) for c in contacts]
    notable = [
        [g for g in _find_groups(c, scales, i) if _is_notable(c, deviation, g, scales.modulus(i))]
        for i, (c, deviation) in enumerate(zip(contacts, deviations, strict=True))
    ]
    slides = [
        (c.contact_kinematics.largest_slide(c.values), c.contact_kinematics.slide_limit)
        for c in contacts
    ]
    if not any(notable):
        exact = 0.0, 0.0, False
        return {
            c.name: SmallDisplacementError(*exact, *s)
            for c, s in zip(contacts, slides, strict=True)
        }
    springs = [d.linearised(c) for d, c in zip(deviations, contacts, strict=True)]
    stiffness, added = zip(*springs, strict=True)
    jumps = respond(stiffness, added)
    results = {}
    for c, groups, k, traction, jump, slide in zip(
        contacts, notable, stiffness, added, jumps, slides, strict=True
    ):
        change = traction_change(k, jump)
        errors = [(0.0, 0.0)] + [_relative_errors(c, g, traction, change) for g in groups]
        force, pressure = np.max(errors, axis=0).tolist()  # NaN if any is NaN
        rough = bool(groups) and not c.contact_kinematics.is_rigid
        results[c.name] = SmallDisplacementError(force, pressure, rough, *slide)
    return results


def _find_groups(contact: Contact, scales: ReferenceScales, number: int) -> list[_Group]:
    """Return the groups of a contact's points, the same on all ranks. Collective."""
    masks = scales.points_by_group(number)
    force = contact.measure * np.linalg.norm(contact.traction, axis=1)
    forces = global_sum(contact.surface.mesh.comm, [force @ points for points in masks.values()])
    unloaded = forces <= scales.round_off_of_groups[list(masks)]
    return [(points, bool(none)) for points, none in zip(masks.values(), unloaded, strict=True)]


def _is_notable(contact: Contact, deviation: Deviation, group: _Group, modulus: float) -> bool:
    """Whether the deviation could change forces or pressures of a group. Collective."""
    comm, (own, unloaded) = contact.surface.mesh.comm, group
    measure, traction = contact.measure[own], contact.traction[own]
    sums = global_sum(comm, [measure @ (contact.pressure[own] > 0), measure.sum()])
    size = float(sums[0] or sums[1]) ** (1 / (contact.points.shape[1] - 1)) or 1.0
    if unloaded:
        gap = max_norm(comm, deviation.gap[own & deviation.closing])
        return not modulus / size * gap <= 0.0
    largest = max_norm(comm, traction)
    rotated = largest * max_norm(comm, deviation.normal_change[own])
    elastic = modulus / size * max_norm(comm, deviation.gap[own])
    lost = max_norm(comm, traction[deviation.lost[own]])
    return not max(rotated, elastic, lost) <= _NEGLIGIBLE_CHANGE_RATIO * largest


def _relative_errors(
    contact: Contact, group: _Group, added: Array, response: Array
) -> tuple[float, float]:
    """Return the relative errors of force and pressure of a group. Collective.

    Tractions change by ``added`` at fixed displacements, and by ``response`` due to displacements,
    (n_points, gdim) each (stress).
    """
    comm, (own, unloaded) = contact.surface.mesh.comm, group
    measure = contact.measure[own]
    added, change = added[own], (added + response)[own]
    pressure = contact.pressure[own]
    force_change = global_sum(comm, measure @ change)
    size = float(global_sum(comm, measure @ np.linalg.norm(contact.traction[own], axis=1)))
    largest = max_norm(comm, pressure) or 1.0  # squares must not overflow
    normal = np.sum(change * contact.values.normal[own], axis=1) / largest
    squares = [measure @ normal**2, measure @ (pressure / largest) ** 2]
    changed, whole = np.sqrt(global_sum(comm, squares))
    if unloaded:
        # The whole contact force is missing, unless a free body moves away.
        magnitudes = [np.linalg.norm(one, axis=1) for one in (change, added)]
        size, fixed = global_sum(comm, [measure @ one for one in magnitudes])
        size = 0.0 if size <= ROUND_OFF * fixed < np.inf else size  # NaN: unknown
    force = float(np.linalg.norm(force_change)) / size if size else 0.0
    return force, float(changed / whole) if whole else 0.0
