"""Return maps: closest-point projections onto the friction cone, eq. (7), in UFL."""

from __future__ import annotations

import math

import ufl

from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Expr

__all__ = [
    "clip",
    "norm",
    "positive_part",
    "return_to_cone",
    "return_to_polygon",
    "return_to_segment",
]

# A point that slipped in the last increment starts at its limit, where round-off must not decide
# between stick and slip: it sticks up to this trial traction relative to the limit.
_SLIP_RATIO = 1 + ROUND_OFF


def positive_part(value: Expr) -> Expr:
    """Return ⟨value⟩₊, with derivative 0 at the kink."""
    return ufl.conditional(ufl.gt(value, 0), value, 0)


def norm(vector: Expr) -> Expr:
    """Return |vector|, with derivative 0 at zero."""
    squared = ufl.dot(vector, vector)
    return ufl.conditional(ufl.gt(squared, 0), ufl.sqrt(squared), 0)


def clip(value: Expr, limit: Expr) -> Expr:
    """Return the number in [-limit, limit] that is closest to ``value``."""
    below = ufl.conditional(ufl.lt(value, -limit), -limit, value)
    return ufl.conditional(ufl.gt(value, limit), limit, below)


def return_to_segment(trial: Expr, limit: Expr, tangent: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """Return map in the plane, with the two modes g = (τ - limit, -τ - limit) [29].

    It needs no norm and is piecewise linear.

    Args:
        trial: Trial traction τ* of a sticking point, shape (2,).
        limit: Friction bound μ p ≥ 0 (stress).
        tangent: Unit vector, shape (2,).

    Returns:
        τ, shape (2,), and k_t Δβ of each mode (stress).
    """
    along = ufl.dot(trial, tangent)
    excess = (_excess(along, limit), _excess(-along, limit))
    slips = ufl.gt(abs(along), _SLIP_RATIO * limit)
    returned = ufl.conditional(slips, clip(along, limit), along)
    return _zero_without_limit(limit, returned) * tangent, excess


def _zero_without_limit(limit: Expr, value: Expr) -> Expr:
    """Return ``value``, or zero where the limit is zero, so that open points never stick."""
    # Trial and limit of an open point are zero: round-off would put k_t into its tangent or not.
    return ufl.conditional(ufl.gt(limit, 0), value, 0 * value)


def _excess(value: Expr, limit: Expr) -> Expr:
    """Return value - limit where the point slips, otherwise 0."""
    return ufl.conditional(ufl.gt(value, _SLIP_RATIO * limit), value - limit, 0)


def return_to_cone(trial: Expr, limit: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """Return τ and k_t Δβ in space, with the one mode g = |τ| - limit of the circular cone."""
    # The norm is used and differentiated only where it exceeds the limit, hence never at zero.
    size = ufl.sqrt(ufl.dot(trial, trial))
    slips = ufl.gt(size, _SLIP_RATIO * limit)
    traction = _zero_without_limit(limit, ufl.conditional(slips, limit / size, 1)) * trial
    return traction, (ufl.conditional(slips, size - limit, 0),)


def return_to_polygon(
    trial: Expr, limit: Expr, sides: list[tuple[Expr, Expr]]
) -> tuple[Expr, tuple[Expr, ...]]:
    """Return map in space, with the modes g_j = τ·a_j - limit of a regular polygon.

    With x = τ*·a_j, y = τ*·b_j and half a side H = limit tan(π/n), mode j is exceeded by
    ⟨x - limit - cot(2π/n) ⟨|y| - H⟩₊⟩₊: beyond the end of the side the excess is divided between
    the side and its neighbour, so that no search for the sector is needed.

    Args:
        trial: Trial traction τ*, shape (3,).
        limit: Radius of the inscribed circle.
        sides: Outward unit normal a_j and unit tangent b_j of every side.

    Returns:
        τ, shape (3,), and k_t Δβ of each mode (stress).
    """
    half_side_ratio, neighbour_factor = (
        math.tan(math.pi / len(sides)),
        1 / math.tan(2 * math.pi / len(sides)),
    )
    traction, excess = trial, []
    for a, b in sides:
        x, y = ufl.dot(trial, a), ufl.dot(trial, b)
        mode_excess = _excess(
            x - neighbour_factor * positive_part(abs(y) - half_side_ratio * limit), limit
        )
        # The closest point of this side; at a vertex both sides give the same point.
        on_side = limit * a + clip(y, half_side_ratio * limit) * b
        traction = ufl.conditional(ufl.gt(mode_excess, 0), on_side, traction)
        excess.append(mode_excess)
    return _zero_without_limit(limit, traction), tuple(excess)
