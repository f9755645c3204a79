"""Return maps: closest-point projections onto the friction cone, eq. (7), in UFL."""

from __future__ import annotations

import math

import ufl

from fenics_contact.types import Expr

__all__ = [
    "clip",
    "norm",
    "positive_part",
    "return_to_cone",
    "return_to_polygon",
    "return_to_segment",
]

# A trial beyond the limit by no more than this share of it sticks. A point that slipped in the last
# increment stands at its limit when the next one begins: whether it sticks or slips there must not
# hang on round-off, which is another one in other units.
_TIE = 1e-12


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
        limit: μ p ≥ 0.
        tangent: Unit vector, shape (2,).

    Returns:
        τ, shape (2,), and k_t Δβ of each mode (stress).
    """
    along = ufl.dot(trial, tangent)
    excess = (_beyond(along, limit), _beyond(-along, limit))
    slips = ufl.gt(abs(along), (1 + _TIE) * limit)
    kept = ufl.conditional(slips, clip(along, limit), along)
    return _where_borne(limit, kept) * tangent, excess


def _where_borne(limit: Expr, value: Expr) -> Expr:
    """Return the value, or zero where the limit is zero: a point without friction never sticks.

    Trial and limit of an open point are both zero; if it counted as sticking, k_t would enter the
    tangent or not by round-off.
    """
    return ufl.conditional(ufl.gt(limit, 0), value, 0 * value)


def _beyond(value: Expr, limit: Expr) -> Expr:
    """Return value - limit where the point slips, else 0."""
    return ufl.conditional(ufl.gt(value, (1 + _TIE) * limit), value - limit, 0)


def return_to_cone(trial: Expr, limit: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """Return τ and k_t Δβ in space, with the one mode g = |τ| - limit of the circular cone."""
    # The norm is only used, and only differentiated, where it exceeds the limit: never at zero.
    size = ufl.sqrt(ufl.dot(trial, trial))
    slips = ufl.gt(size, (1 + _TIE) * limit)
    traction = _where_borne(limit, ufl.conditional(slips, limit / size, 1)) * trial
    return traction, (ufl.conditional(slips, size - limit, 0),)


def return_to_polygon(
    trial: Expr, limit: Expr, sides: list[tuple[Expr, Expr]]
) -> tuple[Expr, tuple[Expr, ...]]:
    """Return map in space, with the modes g_j = τ·a_j - limit of a regular polygon.

    With x = τ*·a_j, y = τ*·b_j and half a side H = limit tan(π/n), mode j is exceeded by
    ⟨x - limit - cot(2π/n) ⟨|y| - H⟩₊⟩₊: beyond the end of the side it shares the excess with its
    neighbour, which is the same formula for the other one. No search for the sector is needed.

    Args:
        trial: τ*, shape (3,).
        limit: Radius of the inscribed circle.
        sides: Outward unit normal a_j of every side, and the unit vector b_j along it.

    Returns:
        τ, shape (3,), and k_t Δβ of each mode (stress).
    """
    half, share = math.tan(math.pi / len(sides)), 1 / math.tan(2 * math.pi / len(sides))
    traction, excess = trial, []
    for a, b in sides:
        x, y = ufl.dot(trial, a), ufl.dot(trial, b)
        over = _beyond(x - share * positive_part(abs(y) - half * limit), limit)
        # The closest point of this side: at a vertex both neighbours give the same.
        on_side = limit * a + clip(y, half * limit) * b
        traction = ufl.conditional(ufl.gt(over, 0), on_side, traction)
        excess.append(over)
    return _where_borne(limit, traction), tuple(excess)
