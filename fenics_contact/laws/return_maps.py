"""Closest admissible tractions: return maps of section 3 (UFL)."""

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
    """⟨value⟩₊, with the derivative 0 at the kink."""
    return ufl.conditional(ufl.gt(value, 0), value, 0)


def norm(vector: Expr) -> Expr:
    """|vector|, with the derivative 0 at zero."""
    squared = ufl.dot(vector, vector)
    return ufl.conditional(ufl.gt(squared, 0), ufl.sqrt(squared), 0)


def clip(value: Expr, limit: Expr) -> Expr:
    """The number between -limit and limit that is nearest to ``value``."""
    below = ufl.conditional(ufl.lt(value, -limit), -limit, value)
    return ufl.conditional(ufl.gt(value, limit), limit, below)


def return_to_segment(trial: Expr, limit: Expr, tangent: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """In the plane: the two modes g = (τ - limit, -τ - limit), eq. (29).

    Needs no norm and is piecewise linear.

    Args:
        trial: τ*, what adherence alone would give, shape (2,).
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
    """A value, or none where the limit is zero: there nothing sticks, not even what is at rest.

    An open point has the trial zero and the limit zero; taken for sticking it would put k_t into
    the tangent, or not, by round-off.
    """
    return ufl.conditional(ufl.gt(limit, 0), value, 0 * value)


def _beyond(value: Expr, limit: Expr) -> Expr:
    """By how much a value exceeds the limit, where it slips."""
    return ufl.conditional(ufl.gt(value, (1 + _TIE) * limit), value - limit, 0)


def return_to_cone(trial: Expr, limit: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """In space: the one mode g = |τ| - limit; see `return_to_segment`."""
    # The norm is only used, and only differentiated, where it exceeds the limit: never at zero.
    size = ufl.sqrt(ufl.dot(trial, trial))
    slips = ufl.gt(size, (1 + _TIE) * limit)
    traction = _where_borne(limit, ufl.conditional(slips, limit / size, 1)) * trial
    return traction, (ufl.conditional(slips, size - limit, 0),)


def return_to_polygon(
    trial: Expr, limit: Expr, sides: list[tuple[Expr, Expr]]
) -> tuple[Expr, tuple[Expr, ...]]:
    """In space: g_j = τ·a_j - limit, the sides of a regular polygon (paper's fig. 3).

    With x = τ*·a_j, y = τ*·b_j and half a side H = limit tan(π/n), mode j is exceeded by
    ⟨x - limit - cot(2π/n) ⟨|y| - H⟩₊⟩₊: beyond the end of the side it shares the excess with its
    neighbour, which is the same formula for the other one. No sector has to be told.

    Args:
        trial: τ*, shape (3,).
        limit: Radius of the inscribed circle.
        sides: Outward unit normal a_j of every side, and the unit vector b_j along it.

    Returns:
        See `return_to_segment`.
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
