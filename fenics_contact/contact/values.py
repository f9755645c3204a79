"""Fields at the quadrature points of Γc, resultants and status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from fenics_contact.types import Array, Mask

__all__ = ["PointValues", "Resultants", "Status", "ZoneExtent"]


class Status(IntEnum):
    """Contact status of a quadrature point of Γc: open, stick or slip."""

    OPEN = 0
    STICK = 1
    SLIP = 2


@dataclass(frozen=True)
class ZoneExtent:
    """Extent of a zone of Γc (contact, stick or slip), the same on every rank.

    Coordinates are those of the outermost quadrature points; the zone ends less than one facet
    beyond these.

    Attributes:
        area: Area of the zone, including the contact's weight; in the plane with a weight of 1
            (default), per unit thickness.
        low, high: Smallest and largest coordinates of its points on the undeformed Γc, (gdim,)
            (length); NaN if it is empty.
    """

    area: float
    low: Array
    high: Array

    @property
    def size(self) -> Array:
        """Size of the zone along each axis, high - low, (gdim,) (length); NaN if it is empty."""
        return self.high - self.low


@dataclass(frozen=True)
class Resultants:
    """Integrals over Γc, numbers of points and extents of zones, the same on every rank.

    Attributes:
        per_thickness: Whether forces, moment and areas are per unit thickness: in the plane with
            the contact's weight 1 (default).
        force: Contact force on the body, ∫ (r_n n + τ), shape (gdim,) (force).
        normal_force: ∫ -r_n, negative in tension (force).
        tangential_force: ∫ |τ| (force).
        moment: Moment of the contact forces on the body about the origin, (1,) or (3,) (force times
            length).
        extents: `ZoneExtent` of "contact" (the points that are not open), "stick" and "slip".
        open, stick, slip: Numbers of quadrature points with this status.
        max_pressure: Largest -r_n at a point (stress).
        max_penetration: Largest δ₋ at a point (length).
    """

    per_thickness: bool
    force: Array
    normal_force: float
    tangential_force: float
    moment: Array
    extents: Mapping[str, ZoneExtent]
    open: int
    stick: int
    slip: int
    max_pressure: float
    max_penetration: float

    @property
    def area(self) -> float:
        """Area of the contact zone, including the contact's weight."""
        return self.extents["contact"].area


@dataclass(frozen=True)
class PointValues:
    """Fields at this rank's points at one state, (n_points,) or (n_points, gdim).

    Fields that the law does not determine are zero, and take no memory.

    Attributes:
        x: Undeformed positions of the points (length).
        normal: Unit normal n from the body to the obstacle.
        facing: Scalar product of n and the outward normal of the body.
        weight: Factor of the surface measure.
        initial_gap: s (length), including the motion of the obstacle.
        shift: Prescribed displacement of the obstacle (length).
        parameters: Parameters of the law, by name.
        paired: 1 if the point has an opposite point, otherwise 0.
        depth: Penetration into the opposing body, without a prescribed gap (length).
        slide: Tangential jump since the pairs were found (length).
        jump: Displacement relative to the obstacle (length).
        normal_displacement: u_n (length).
        opening, penetration: δ₊ and δ₋ (length).
        normal_traction: r_n (stress).
        normal_stiffness: -∂r_n/∂u_n where closed (stress/length).
        normal_reaction: r_n by the law's own potential, if it has one (stress).
        traction: τ on the body (stress).
        friction_bound_ratio: Bound of |τ|/p over all directions; infinite if |τ| is not bounded by
            the pressure, 0 without tangential resistance.
        circumradius: Largest |τ| on the yield surface, relative to its friction bound; infinite if
            unknown.
        stored: Elastic energy of the contact per area.
        increment: Δu_t since the last commit (length).
        old_traction: τ at the start of the increment (stress).
        friction_bound: Size of the yield surface (stress).
        law_friction_bound: `Law.friction_bound` at the contact pressure (stress).
        friction_bound_slope: Its derivative by the pressure.
        dissipated: Frictional dissipation per area.
        slip_increment: Δβ of every mode, (n_points, n_modes) (length).
        multiplier: λ_n (stress).
        elastic_slip: K_t⁻¹ (λ_t - τ) (length), in the frame of the history.
        projection_point: Displacement by which the history measures slip, in the frame of the
            obstacle (length): the jump, or with finite kinematics that of the projection point.
        framed_traction, framed_normal: τ (stress) and n in the frame of the obstacle.
        carried_traction: The committed τ, rotated with obstacle and normal since (stress).
        arrays: All evaluated fields by name, for files.
    """

    x: Array
    normal: Array
    facing: Array
    weight: Array
    initial_gap: Array
    shift: Array
    parameters: Mapping[str, Array]
    paired: Array
    depth: Array
    slide: Array
    jump: Array
    normal_displacement: Array
    opening: Array
    penetration: Array
    normal_traction: Array
    normal_stiffness: Array
    normal_reaction: Array
    traction: Array
    friction_bound_ratio: Array
    circumradius: Array
    stored: Array
    increment: Array
    old_traction: Array
    friction_bound: Array
    law_friction_bound: Array
    friction_bound_slope: Array
    dissipated: Array
    slip_increment: Array
    multiplier: Array
    elastic_slip: Array
    projection_point: Array
    framed_traction: Array
    framed_normal: Array
    carried_traction: Array
    arrays: Mapping[str, Array]

    @classmethod
    def of(cls, arrays: Mapping[str, Array]) -> PointValues:
        """Return the values of evaluated arrays; "parameter NAME" are parameters."""
        n, d = arrays["x"].shape
        parameters = {
            name.removeprefix("parameter "): values
            for name, values in arrays.items()
            if name.startswith("parameter ")
        }
        zero, zeros = (np.broadcast_to(0.0, shape) for shape in ((n,), (n, d)))
        # Members that some laws do not need; all others are always evaluated.
        scalars = (
            *("normal_reaction", "friction_bound_ratio", "circumradius", "friction_bound"),
            *("law_friction_bound", "friction_bound_slope", "dissipated", "multiplier", "depth"),
        )
        vectors = ("slide", "traction", "increment", "old_traction", "elastic_slip")
        members: dict[str, Any] = dict.fromkeys(scalars, zero) | dict.fromkeys(vectors, zeros)
        members["paired"] = np.broadcast_to(1.0, (n,))
        members["normal_stiffness"] = parameters.get("k_n", zero)
        members["slip_increment"] = np.broadcast_to(0.0, (n, 0))
        members |= {f.name: arrays[f.name] for f in fields(cls) if f.name in arrays}
        # The frame of the history is fixed in space with small displacements.
        aliases = {"projection_point": "jump", "carried_traction": "old_traction"}
        aliases |= {"framed_traction": "traction", "framed_normal": "normal"}
        members |= {name: members[other] for name, other in aliases.items() if name not in arrays}
        return cls(**members | {"parameters": parameters, "arrays": arrays})

    def at(self, points: Mask) -> PointValues:
        """Return the values at some of the points."""
        return self.of({name: values[points] for name, values in self.arrays.items()})

    @cached_property
    def tangential_stiffness(self) -> Array:
        """K_t of a sticking point, (n_points, gdim, gdim) (stress/length)."""
        n, d = self.x.shape
        if "tangential_stiffness 0" not in self.arrays:
            return np.broadcast_to(0.0, (n, d, d))
        rows = [self.arrays[f"tangential_stiffness {i}"] for i in range(d)]
        return np.stack(rows, axis=1)

    @property
    def gap(self) -> Array:
        """Normal gap g_N = s - u_n = δ₊ - δ₋, eq. (6)."""
        return self.opening - self.penetration

    @property
    def friction_secant(self) -> Array:
        """Secant stiffness of friction relative to K_t, (n_points,): 1 at sticking points."""
        stick = self.old_traction - np.einsum(
            "qij,qj->qi", self.tangential_stiffness, self.increment
        )
        traction, trial = (np.linalg.norm(v, axis=1) for v in (self.traction, stick))
        return np.where(trial > 0, traction / np.where(trial > 0, trial, 1.0), 1.0)

    @property
    def is_slipping(self) -> Mask:
        """Mask of the points that slip against friction, including open ones, (n_points,)."""
        return np.asarray(np.any(self.slip_increment != 0, axis=1))

    def springs(self, normal: npt.ArrayLike, tangential: npt.ArrayLike) -> Array:
        """Return the symmetric stiffness a K_n + b K_t of the quasi-Newton method at the points.

        Args:
            normal: Factor a, a number or (n_points,).
            tangential: Factor b, a number or (n_points,).

        Returns:
            Array (n_points, gdim, gdim) (stress/length).
        """
        projector = np.einsum("qi,qj->qij", self.normal, self.normal)
        stiffness = np.asarray(normal) * self.normal_stiffness
        factor = np.broadcast_to(np.asarray(tangential), self.normal_stiffness.shape)
        return np.asarray(
            stiffness[:, None, None] * projector + factor[:, None, None] * self.tangential_stiffness
        )

    @property
    def total_traction(self) -> Array:
        """Total traction r_n n + τ on the body (stress)."""
        return self.normal_traction[:, None] * self.normal + self.traction

    @cached_property
    def slip_vector(self) -> Array:
        """Slip Δu_t + K_t⁻¹ Δτ of the increment; Δu_t if the law has no k_t.

        Raises:
            numpy.linalg.LinAlgError: K_t is singular.
        """
        if "k_t" not in self.parameters:
            return self.increment
        # K_t is singular along the normal, where nothing acts: add any stiffness.
        projector = np.einsum("q,qi,qj->qij", self.parameters["k_t"], self.normal, self.normal)
        change = (self.traction - self.old_traction)[:, :, None]
        elastic = np.linalg.solve(self.tangential_stiffness + projector, change)[:, :, 0]
        return np.asarray(self.increment + elastic, dtype=np.float64)

    def tangential(self, vectors: Array) -> Array:
        """Return the part of vectors across the normal, (n_points, gdim)."""
        return vectors - np.sum(vectors * self.normal, axis=1)[:, None] * self.normal

    def status(self, *, tension: bool, sticks: bool) -> npt.NDArray[np.int8]:
        """Return the `Status` of every point, (n_points,); unpaired points are open.

        Args:
            tension: Whether the law bears tension, so that no paired point is open.
            sticks: Whether there are tangential tractions; if not, closed points count as slip.
        """
        closed = (self.paired > 0) & ((self.normal_traction < 0) | tension)
        status = np.where(closed, Status.SLIP, Status.OPEN).astype(np.int8)
        if sticks:
            status[closed & ~self.is_slipping] = Status.STICK
        return status
