"""Error of the small-displacement assumption: gap and normal at the deformed position.

The gap is s - u_n with s and n of the undeformed body, eq. (1). At X + u both differ, due to the
curvature of the obstacle or rotations. The change of the contact forces follows from one linear
solve with the present tangent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fenics_contact.checks.condition import Condition
from fenics_contact.contact.body import NEGLIGIBLE_SLIDE
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import global_mean, global_min, global_sum, longest
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Mask
from fenics_contact.wording import percent

__all__ = [
    "Deviation",
    "Linearisation",
    "Respond",
    "linearisation",
    "spring_stiffness",
    "traction_change",
]

# The change of the relative displacements at the points of every contact by springs there and by
# tractions added on the body.
Respond = Callable[[Sequence[Array], Sequence[Array]], Sequence[Array]]
# Mask of this rank's points of a contact on one group of coupled bodies, (n_points,), and whether
# they bear nothing but round-off, as after an increment to no load.
_Part = tuple[Mask, bool]
# Share of the largest pressure, or of the force, below which what is left out needs no solve.
_NEGLIGIBLE = 1e-3
# Difference of the displacements on Γc, as a share of its size, below which pairs in the deformed
# bodies are those of before.
_TURNED = 1e-3
# Share by which small displacements may change forces or pressures before it is said.
_NOTABLE = 0.01


def spring_stiffness(contact: Contact) -> Array:
    """What the traction loses per displacement at the present state, (n_points, gdim, gdim).

    Linearised, with the status of the points as it is.
    """
    law, values, status = contact.law, contact.values, contact.status
    normal = values.normal
    d = normal.shape[1]
    stiffness = np.zeros((len(normal), d, d))
    if law.has_normal_stiffness:
        # A slipping point's friction follows the pressure as its bound does.
        follows = (status == Status.SLIP) & (contact.pressure > 0) & (values.friction_bound > 0)
        slope = np.where(follows, values.friction_bound_slope, 0.0)
        ratio = slope / np.where(follows, values.friction_bound, 1.0)
        direction = normal - ratio[:, None] * contact.tangential_traction
        k_n = np.where(status != Status.OPEN, contact.normal_stiffness, 0.0)
        stiffness += k_n[:, None, None] * np.einsum("qi,qj->qij", direction, normal)
    if law.has_tangential:
        sticks = (status == Status.STICK)[:, None, None]
        stiffness += np.where(sticks, contact.tangential_stiffness, 0.0)
        stiffness += _turning_stiffness(contact)
    return stiffness


def traction_change(stiffness: Array, jump: Array) -> Array:
    """Change of the traction by one of the relative displacement, (n_points, gdim) (stress)."""
    return -np.einsum("qij,qj->qi", stiffness, jump)


def _turning_stiffness(contact: Contact) -> Array:
    """Stiffness of friction that turns with the direction of slip, (n_points, gdim, gdim).

    Of slipping points in space, where it may be all that holds a body; in the plane it is none.
    That of circular and elliptic friction cones, by which polygonal ones are approximated.
    """
    values, d = contact.values, contact.values.normal.shape[1]
    stiffness: Array = np.zeros((len(values.normal), d, d))
    slips = contact.status == Status.SLIP
    if d == 2 or not slips.any():
        return stiffness
    traction, k_t = values.traction[slips], values.tangential_stiffness[slips]
    stretch = np.einsum("qij,qj->qi", np.linalg.pinv(k_t, hermitian=True), traction)
    energy = np.sum(traction * stretch, axis=1)
    along = np.einsum("qi,qj->qij", traction, traction)
    along /= np.where(energy > 0, energy, np.inf)[:, None, None]
    secant = np.where(energy > 0, values.friction_secant[slips], 0.0)
    stiffness[slips] = secant[:, None, None] * (k_t - along)
    return stiffness


@dataclass(frozen=True)
class Linearisation:
    """Relative error of a contact due to the small-displacement assumption, on every rank.

    Of several groups of bodies that it presses on each other or on obstacles the largest errors.

    Attributes:
        force: Error of the contact force, the magnitude of its change.
        pressure: Error of the pressure, in the L² norm over Γc.
        rough: Whether the estimate of the pressure is inaccurate, as between two meshes.
        slid: How far points that transmit forces have slid on another body from where these act,
            in sizes of their facets.
        slide_limit: How far they may have.
    """

    force: float = 0.0
    pressure: float = 0.0
    rough: bool = False
    slid: float = 0.0
    slide_limit: float = np.inf

    @property
    def worst(self) -> float:
        """The larger of the errors of force and pressure; infinite if one is not finite."""
        worst = max(self.force, self.pressure)
        return worst if np.isfinite(self.force) and np.isfinite(self.pressure) else np.inf

    @property
    def is_notable(self) -> bool:
        """Whether the error of force or pressure exceeds 1 %."""
        return self.worst > _NOTABLE

    def conditions(self, contact: str, tolerance: float) -> list[Condition]:
        """The conditions on a contact of this name, by the largest error accepted."""
        if tolerance == np.inf:
            return []
        if np.isfinite(self.judged):
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
            f"points have slid by {self.slid:.2g} facets from where their forces act on the "
            f"opposing body, more than {self.slide_limit:g}. Use smaller increments, "
            'update_pairs="auto" where it is "never", or Contact(kinematics="finite"), or accept '
            "the error: ContactProblem(small_displacement_tolerance=inf)"
        )
        return [
            Condition(f"{name}, {contact}", value, limit, f"{contact}: {failure}")
            for name, value, limit, failure in (
                ("small displacements", self.judged, tolerance, error),
                ("slide off the opposite points", self.slid, self.slide_limit, slide),
            )
        ]

    def is_due_to_pairs(self, tolerance: float) -> bool:
        """Whether pairs found where the points are now may take away a notable error."""
        notable = self.judged > _NOTABLE and self.slid > NEGLIGIBLE_SLIDE
        return notable or not all(each.holds for each in self.conditions("", tolerance))

    def describe(self) -> str:
        """Return the errors in words."""
        return (
            f"the contact force would differ by {percent(self.force)} and the pressure by "
            f"{percent(self.pressure)}"
        )

    @property
    def judged(self) -> float:
        """The error that is compared with the tolerance: of the force only, if ``rough``."""
        return self.force if self.rough and np.isfinite(self.worst) else self.worst


@dataclass(frozen=True)
class Deviation:
    """How gap and normal at the points differ from the linearised ones.

    Attributes:
        gap: True gap minus s - u_n where points are closed, the true gap where points that are open
            penetrate, 0 elsewhere, (n_points,) (length).
        turn: Change of the unit normal of closed points, (n_points, gdim).
        normal: The true unit normal, (n_points, gdim).
        lost: Closed points that have nothing opposite any more, (n_points,).
        closing: Open points that penetrate where the bodies have moved to, (n_points,).
    """

    gap: Array
    turn: Array
    normal: Array
    lost: Mask
    closing: Mask

    @classmethod
    def of(cls, contact: Contact) -> Deviation:
        """At the evaluated state of a contact; nothing where it could not be told. Collective."""
        values, closed = contact.values, contact.status != Status.OPEN
        zero, nothing = np.zeros(len(closed)), np.zeros(len(closed), dtype=np.bool_)
        none = cls(zero, np.zeros_like(values.normal), values.normal, nothing, nothing)
        exact = contact.finite or contact.contact_kinematics.is_flat
        if exact or not (contact.rigid or _moves(contact)):
            return none
        change, normal = contact.contact_kinematics.deviation(values)
        if not contact.rigid:
            # It jumps from point to point; what is answered to is a function on Γc.
            paired = contact.paired & ~np.isnan(change)
            smooth = contact.traces(np.where(paired, change, 0.0))
            change = np.where(paired, smooth, change)
        told = np.isfinite(normal).all(axis=1)
        turn = np.where((told & closed)[:, None], normal - values.normal, 0.0)
        # At the very end of the opposite surface points keep their pairs while they do not slide.
        slid = (
            np.linalg.norm(values.slide, axis=1) > NEGLIGIBLE_SLIDE * contact.quadrature.facet_sizes
        )
        lost = told & closed & slid & np.isnan(change)
        if contact.gap_prescribed:  # pairs keep theirs, and of others none is known
            return cls(zero, turn, normal, lost, nothing)
        true = np.where(contact.paired, values.gap, 0.0) + change
        size = np.linalg.norm(values.x, axis=1) + contact.quadrature.facet_sizes
        apart = ROUND_OFF * size
        if not contact.rigid:  # facets that meet at angles make as much of a gap where points close
            apart += longest(contact.surface.mesh.comm, np.nan_to_num(change[closed]))
        closing = told & ~closed & (true < -apart)
        gap = np.where(told & closed & ~lost, np.nan_to_num(change), np.where(closing, true, 0.0))
        return cls(gap, turn, normal, lost, closing)

    def linearised(self, contact: Contact) -> tuple[Array, Array]:
        """Stiffness of the springs where the bodies have moved to: lost ones and new ones.

        Returns:
            It, (n_points, gdim, gdim), see `spring_stiffness`, and the change of the tractions
            while displacements stay, (n_points, gdim) (stress).
        """
        traction, values = contact.traction, contact.values
        k_n = np.where(self.closing, contact.normal_stiffness, 0.0)
        added = k_n[:, None, None] * np.einsum("qi,qj->qij", self.normal, self.normal)
        lost = self.lost[:, None]
        stiffness = np.where(lost[:, None], 0.0, spring_stiffness(contact)) + added
        turned = values.normal_traction[:, None] * self.turn
        along = np.where(self.closing[:, None], self.normal, values.normal)
        change = turned + traction_change(stiffness, -self.gap[:, None] * along)
        return stiffness, np.where(lost, -traction, change)


def _moves(contact: Contact) -> bool:
    """Whether bodies slide or turn by enough for a search anew to find anything. Collective."""
    comm, values = contact.surface.mesh.comm, contact.values
    smallest = global_min(comm, contact.quadrature.facet_sizes, empty=np.inf)
    x, u = values.x, contact.own_displacement()
    # A point without an opposite may find one wherever it goes.
    slid = longest(comm, np.where(contact.paired[:, None], values.slide, u))
    size = max(longest(comm, x - global_mean(comm, x)), 1e-300)
    turned = longest(comm, u - global_mean(comm, u)) / size
    return not (slid <= NEGLIGIBLE_SLIDE * smallest and turned <= _TURNED)


def linearisation(
    contacts: Sequence[Contact], scales: ReferenceScales, respond: Respond
) -> dict[str, Linearisation]:
    """Estimate the error of the small-displacement assumption, by contact. Collective.

    Where a contact is of several bodies, or groups of them that it couples, it is that of the worst
    one, relative to what that bears. The contacts are evaluated, at a solution.
    """
    deviations = [Deviation.of(c) for c in contacts]
    looked_at = [
        [part for part in _parts(c, scales, i) if _matters(c, deviation, part, scales.modulus(i))]
        for i, (c, deviation) in enumerate(zip(contacts, deviations, strict=True))
    ]
    slides = [
        (c.contact_kinematics.largest_slide(c.values), c.contact_kinematics.slide_limit)
        for c in contacts
    ]
    if not any(looked_at):
        none = 0.0, 0.0, False
        return {c.name: Linearisation(*none, *s) for c, s in zip(contacts, slides, strict=True)}
    springs = [d.linearised(c) for d, c in zip(deviations, contacts, strict=True)]
    stiffness, added = zip(*springs, strict=True)
    jumps = respond(stiffness, added)
    found = {}
    for c, parts, k, traction, jump, slide in zip(
        contacts, looked_at, stiffness, added, jumps, slides, strict=True
    ):
        errors = [(0.0, 0.0)] + [_relative(c, p, traction, traction_change(k, jump)) for p in parts]
        force, pressure = np.max(errors, axis=0).tolist()  # one that is not a number wins
        rough = bool(parts) and not c.rigid
        found[c.name] = Linearisation(force, pressure, rough, *slide)
    return found


def _parts(contact: Contact, scales: ReferenceScales, number: int) -> list[_Part]:
    """The parts of the contact of a number, the same on all ranks. Collective."""
    masks = scales.parts_of(number)
    force = contact.measure * np.linalg.norm(contact.traction, axis=1)
    borne = global_sum(contact.surface.mesh.comm, [force @ points for points in masks.values()])
    idle = borne <= scales.round_off_of_groups[list(masks)]
    return [(points, bool(none)) for points, none in zip(masks.values(), idle, strict=True)]


def _matters(contact: Contact, deviation: Deviation, part: _Part, modulus: float) -> bool:
    """Whether what is left out could change forces or pressures of a part. Collective."""
    comm, (own, idle) = contact.surface.mesh.comm, part
    measure, traction = contact.measure[own], contact.traction[own]
    sums = global_sum(comm, [measure @ (contact.pressure[own] > 0), measure.sum()])
    size = float(sums[0] or sums[1]) ** (1 / (contact.points.shape[1] - 1)) or 1.0
    if idle:
        gap = longest(comm, deviation.gap[own & deviation.closing])
        return not modulus / size * gap <= 0.0
    largest = longest(comm, traction)
    turn = largest * longest(comm, deviation.turn[own])
    push = modulus / size * longest(comm, deviation.gap[own])
    gone = longest(comm, traction[deviation.lost[own]])
    return not max(turn, push, gone) <= _NEGLIGIBLE * largest


def _relative(contact: Contact, part: _Part, added: Array, answered: Array) -> tuple[float, float]:
    """Errors of force and pressure of a part, see `Linearisation`. Collective.

    Args:
        contact: Evaluated.
        part: Of it.
        added: Change of the tractions while displacements stay, (n_points, gdim) (stress).
        answered: That by the displacements which answer it, (n_points, gdim) (stress).
    """
    comm, (own, idle) = contact.surface.mesh.comm, part
    measure = contact.measure[own]
    added, change = added[own], (added + answered)[own]
    pressure = contact.pressure[own]
    force_change = global_sum(comm, measure @ change)
    size = float(global_sum(comm, measure @ np.linalg.norm(contact.traction[own], axis=1)))
    largest = longest(comm, pressure) or 1.0  # squares must not overflow
    along = np.sum(change * contact.values.normal[own], axis=1) / largest
    squares = [measure @ along**2, measure @ (pressure / largest) ** 2]
    changed, whole = np.sqrt(global_sum(comm, squares))
    if idle:
        # All of what it ought to bear is missing, but where a free body moves out of the way.
        both = [np.linalg.norm(one, axis=1) for one in (change, added)]
        size, at_rest = global_sum(comm, [measure @ one for one in both])
        size = 0.0 if size <= ROUND_OFF * at_rest < np.inf else size  # NaN: nothing is known
    force = float(np.linalg.norm(force_change)) / size if size else 0.0
    return force, float(changed / whole) if whole else 0.0
