"""Which system to iterate on, and how to solve linear systems over all unknowns."""

from __future__ import annotations

from collections.abc import Sequence

from fenics_contact.systems import linear
from fenics_contact.systems.candidate_dofs import touched
from fenics_contact.systems.condensed import all_retained, worthwhile
from fenics_contact.systems.full import FullSystem

__all__ = ["linear_kind", "reason_not_to_condense"]


def reason_not_to_condense(
    full: FullSystem,
    *,
    wanted: bool | None,
    linear_solver: str | None,
    named: Sequence[str],
    increments: int,
    n_retained: int,
) -> str | None:
    """Why not to iterate on the unknowns that contact touches alone; None: do. Collective.

    Args:
        full: All unknowns.
        wanted: What the caller says; None: where it can be done and is worth it.
        linear_solver: What the caller wants for systems over all unknowns.
        named: Options given that name a linear solver, which the dense one cannot be.
        increments: How many of them are expected.
        n_retained: How many unknowns there would be.

    Raises:
        ValueError: It is wanted and cannot be had.
    """
    unknowns, gdim = full.unknowns, full.gdim
    obstacle = None
    if not full.contacts:
        obstacle = "there is no contact"
    elif not full.bulk.linear:
        obstacle = "the bulk is not linear in u"
    elif full.displacement.mixed:
        obstacle = "the displacement is a part of a mixed function"
    elif full.follows and not full.scales.held.all():
        obstacle = "bodies with finite kinematics are constrained by contact only"
    elif full.follows and not all_retained(unknowns.n_global, _n_touched(full), gdim):
        obstacle = "finite kinematics couple more dofs than can be retained"
    elif named:
        obstacle = f"the options name a linear solver ({', '.join(named)})"
    elif linear_solver == "multigrid":
        obstacle = "linear_solver is 'multigrid', and condensation needs a factorisation"
    if wanted and obstacle:
        raise ValueError(
            f"condensation is True, but {obstacle}; omit it, or give condensation=False"
        )
    if wanted is False:
        return "condensation is False"
    if wanted or obstacle:
        return obstacle
    n = unknowns.n_global
    if n_retained == n or not worthwhile(n, n_retained, gdim):
        return f"contact couples {n_retained} of {n} unknowns, too many for it to save time"
    if unknowns.n_motions or linear_solver is not None:
        return None
    n_bytes = linear.factor_bytes(n, gdim, symmetric=full.bulk.symmetric)
    obstacle = linear.too_large(n_bytes, unknowns.comm)
    if not obstacle and linear.quicker(full.size_to_factor, gdim, condensed_for=increments):
        obstacle = f"multigrid is faster for {n} unknowns"
    return obstacle or None


def _n_touched(full: FullSystem) -> int:
    """How many unknowns contact touches, or may touch with other pairs. Collective."""
    return int(full.unknowns.comm.allreduce(touched(full.operators, full.unknowns).size))


def linear_kind(
    full: FullSystem,
    *,
    wanted: str | None,
    condensed: bool,
    named: Sequence[str],
    symmetric: bool,
    tangent_symmetric: bool,
) -> tuple[str, str]:
    """How to solve systems over all unknowns, one of `linear.KINDS`, and why. Collective.

    Args:
        full: All unknowns.
        wanted: What the caller says.
        condensed: Whether another system is iterated on.
        named: Options given that name a linear solver; they win.
        symmetric: Whether the matrix of H₀ is.
        tangent_symmetric: Whether the consistent tangent is.

    Raises:
        ValueError: The caller wants what cannot work.
    """
    kind, reason = wanted, "chosen by linear_solver"
    if full.displacement.mixed:
        if kind == "multigrid":
            raise ValueError(
                "linear_solver is 'multigrid', but u is a part of a mixed function, whose "
                "equations are a saddle-point problem, which multigrid for displacements does not "
                "solve; use 'direct', or omit it"
            )
        return "direct", "the displacement is a part of a mixed function"
    if kind is None:
        n, gdim = full.unknowns.first_motion, full.gdim
        n_bytes = linear.factor_bytes(n, gdim, symmetric=symmetric)
        if not tangent_symmetric:  # L-BFGS keeps the factors of both
            n_bytes += linear.factor_bytes(n, gdim, symmetric=False)
        reason = linear.too_large(n_bytes, full.unknowns.comm) or ""
        if not reason and linear.quicker(full.size_to_factor, gdim):
            reason = "it is faster for this size"
        kind = "multigrid" if reason and not condensed and not named else "direct"
    if kind == "multigrid" and full.unknowns.n_motions:
        return "direct", "multigrid does not treat unknown motions of obstacles"
    return kind, reason
