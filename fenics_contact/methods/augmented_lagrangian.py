"""Augmented Lagrangian method: solutions with fixed multipliers, and augmentations between them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fenics_contact.methods.acceleration import Acceleration
from fenics_contact.methods.attempt import Attempt
from fenics_contact.methods.equations import Equations
from fenics_contact.parallel import global_sum
from fenics_contact.systems.multiplier_projection import project_multiplier_updates
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["RESIDUAL_RATIO", "solve_augmented_lagrangian"]

logger = logging.getLogger("fenics_contact")

_MAX_AUGMENTATIONS = 80
# Relative residual of the first solution, and ratio of that of the next to the enforcement error.
_FIRST_RTOL, RESIDUAL_RATIO = 1e-4, 1e-2
# Enforcement error by its tolerance below which the next solution has the full accuracy.
_NEARLY_CONVERGED_RATIO = 10.0
# An overload is final if tractions may still grow by less than this fraction of the missing
# friction.
_FINAL_OVERLOAD_GROWTH_RATIO = 0.1
# Multipliers are scaled down if the load falls below this fraction, except to zero: multipliers
# that are too large open the contact, and without any it would depend on round-off.
_REDUCED_LOAD_RATIO = 0.2


def solve_augmented_lagrangian(
    equations: Equations,
    iterate: Callable[[bool], tuple[int, list[Attempt]]],
    load_before: Array,
) -> tuple[int, list[Attempt], int]:
    """Alternate solutions and augmentations until the multipliers converge. Collective.

    Without multipliers there is one solution.

    Args:
        equations: The equations.
        iterate: Solve with fixed multipliers; takes whether it is the first solution, returns the
            SNES reason and the attempts.
        load_before: External forces at this rank's unknowns in the committed state (force).

    Returns:
        Reason of the last solution, attempts, and number of solutions.
    """
    augmented = [c for c in equations.contacts if c.multipliers is not None]
    if not augmented:
        return *iterate(True), 1
    _scale_down_multipliers(equations, load_before)
    attempts: list[Attempt] = []
    exact = False
    acceleration = Acceleration(equations.full.contacts, equations.full.scales)
    equations.augmentation_rtol = _FIRST_RTOL  # inexact solutions suffice for inexact multipliers
    try:
        for number in range(1, _MAX_AUGMENTATIONS + 1):
            start = equations.system.state()
            reason, tried = iterate(number == 1)
            _append(attempts, tried)
            overload = equations.overload
            if reason <= 0 and overload is None:
                break
            for operator in equations.full.operators:
                if operator.contact in augmented:
                    operator.contact.evaluate()
                    project_multiplier_updates(
                        operator, equations.full.state(), equations.full.constrained
                    )
            errors = [c.enforcement_error() for c in augmented]
            worst = max(e / c.tolerance for e, c in zip(errors, augmented, strict=True))
            logger.debug("augmentation %d: errors %s", number, errors)
            # A soft penalty underestimates pressure and friction under prescribed displacements:
            # an overload counts only once multipliers have converged. An augmentation corrects no
            # more than the ratio of the penalty to the bulk's stiffness of the error.
            correction = min(1.0, equations.stiffness_ratio()) if overload else 1.0
            if overload is not None:
                growth = max(errors) / correction
                if growth < _FINAL_OVERLOAD_GROWTH_RATIO * (overload.factor - 1.0) < np.inf:
                    break
            if worst <= correction and (exact or overload):
                break
            exact = worst <= _NEARLY_CONVERGED_RATIO
            least = min((e for e in errors if e > 0), default=0.0)
            equations.augmentation_rtol = 0.0 if exact else min(_FIRST_RTOL, RESIDUAL_RATIO * least)
            if number < _MAX_AUGMENTATIONS and worst > correction:
                acceleration.augment()
                if overload:  # the overload may have moved bodies too far away
                    equations.system.set_state(start)
    finally:
        equations.augmentation_rtol = 0.0
    return reason, attempts, number


def _scale_down_multipliers(equations: Equations, load_before: Array) -> None:
    """Scale the initial λ_n of an increment with a load that has fallen much. Collective.

    Multipliers of a much larger load reduce the contact to the few points where they are largest,
    from where the augmentations converge slowly or not at all. They are only initial values.
    """
    full = equations.full
    sizes = full.by_body(full.load, load_before)
    for operator in full.operators:
        if operator.contact.multipliers is None:
            continue
        coupled = np.zeros(full.n_bodies)
        coupled[full.partition.label[operator.coupled_dofs]] = 1.0
        bodies = global_sum(full.unknowns.comm, coupled) > 0.0
        if not sizes[1, bodies].any():  # bodies loaded by others only: all of the group
            bodies = np.isin(full.scales.group, full.scales.group[bodies])
        present, before = (float(np.linalg.norm(size[bodies])) for size in sizes)
        if NEGLIGIBLE * before < present < _REDUCED_LOAD_RATIO * before:
            operator.contact.multipliers.scale_pressure(present / before)
            operator.contact.states.forget()


def _append(attempts: list[Attempt], tried: Sequence[Attempt]) -> None:
    """Append attempts; consecutive ones of equal method and outcome are merged."""
    for attempt in tried:
        last = attempts[-1] if attempts else None
        if last and (last.method, last.outcome) == (attempt.method, attempt.outcome):
            attempts[-1] = replace(attempt, iterations=last.iterations + attempt.iterations)
        else:
            attempts.append(attempt)
