"""Selection of the system to iterate on, and of the solver for systems over all unknowns."""

from __future__ import annotations

from collections.abc import Sequence

from fenics_contact.systems import linear
from fenics_contact.systems.candidate_dofs import find_coupled_dofs
from fenics_contact.systems.condensed import is_worthwhile, should_retain_all
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
    """Return why static condensation is not used; None if it is. Collective.

    Args:
        full: The system on all unknowns.
        wanted: The user's choice; None: condense if possible and is_worthwhile.
        linear_solver: The user's choice for systems over all unknowns.
        named: Options given that select a linear solver, which excludes the dense one.
        increments: Expected number of increments.
        n_retained: Number of unknowns to retain.

    Raises:
        ValueError: It is requested and impossible.
    """
    unknowns, gdim = full.unknowns, full.gdim
    reason = None
    if not full.contacts:
        reason = "there is no contact"
    elif not full.bulk.linear:
        reason = "the bulk is not linear in u"
    elif full.displacement.is_mixed:
        reason = "the displacement is a part of a mixed function"
    elif full.follows and not full.scales.constrained.all():
        reason = "bodies with finite kinematics are constrained by contact only"
    elif full.follows and not should_retain_all(unknowns.n_global, _count_coupled(full), gdim):
        reason = "finite kinematics couple more dofs than can be retained"
    elif named:
        reason = f"the options name a linear solver ({', '.join(named)})"
    elif linear_solver == "multigrid":
        reason = "linear_solver is 'multigrid', and condensation needs a factorisation"
    if wanted and reason:
        raise ValueError(f"condensation is True, but {reason}; omit it, or give condensation=False")
    if wanted is False:
        return "condensation is False"
    if wanted or reason:
        return reason
    n = unknowns.n_global
    if n_retained == n or not is_worthwhile(n, n_retained, gdim):
        return f"contact couples {n_retained} of {n} unknowns, too many for it to save time"
    if unknowns.n_motions or linear_solver is not None:
        return None
    n_bytes = linear.factor_bytes(n, gdim, symmetric=full.bulk.symmetric)
    reason = linear.describe_memory_excess(n_bytes, unknowns.comm)
    if not reason and linear.is_multigrid_faster(
        full.size_to_factor, gdim, condensed_for=increments
    ):
        reason = f"multigrid is faster for {n} unknowns"
    return reason or None


def _count_coupled(full: FullSystem) -> int:
    """Count the unknowns that contact couples, or may couple with other pairs. Collective."""
    return int(full.unknowns.comm.allreduce(find_coupled_dofs(full.operators, full.unknowns).size))


def linear_kind(
    full: FullSystem,
    *,
    wanted: str | None,
    condensed: bool,
    named: Sequence[str],
    symmetric: bool,
    tangent_symmetric: bool,
) -> tuple[str, str]:
    """Return one of `linear.KINDS` for systems over all unknowns, and the reason. Collective.

    Args:
        full: The system on all unknowns.
        wanted: The user's choice.
        condensed: Whether the iteration is on a condensed system.
        named: Options given that select a linear solver; they take precedence.
        symmetric: Whether the matrix of H₀ is symmetric.
        tangent_symmetric: Whether the consistent tangent is symmetric.

    Raises:
        ValueError: The user's choice does not work.
    """
    kind, reason = wanted, "chosen by linear_solver"
    if full.displacement.is_mixed:
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
        reason = linear.describe_memory_excess(n_bytes, full.unknowns.comm) or ""
        if not reason and linear.is_multigrid_faster(full.size_to_factor, gdim):
            reason = "it is faster for this size"
        kind = "multigrid" if reason and not condensed and not named else "direct"
    if kind == "multigrid" and full.unknowns.n_motions:
        return "direct", "multigrid does not treat unknown motions of obstacles"
    return kind, reason
