"""Rounds of multipliers: solutions one after another, between which they take over from springs."""

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
from fenics_contact.types import Array

__all__ = ["INNER", "solve_augmented_lagrangian"]

logger = logging.getLogger("fenics_contact")

# Rounds before it is given up.
_MAX_ROUNDS = 80
# Residual, relative, to which the first round is solved; share of a round's error to which the next
# is; and the error, in units of the tolerance, from which on the next may be the last one.
_FIRST_ROUND, INNER, _NEARLY = 1e-4, 1e-2, 10.0
# An overload is sure if tractions may still grow by less than this share of what friction lacks.
_SURELY = 0.1
# Multipliers begin smaller where the load has fallen to less than this share. To less than the
# second it is gone: without multipliers a body would be left to touch by round-off, and multipliers
# that are too large leave it open.
_FELL, _NOTHING = 0.2, 1e-10


def solve_augmented_lagrangian(
    equations: Equations,
    iterate: Callable[[bool], tuple[int, list[Attempt]]],
    load_before: Array,
) -> tuple[int, list[Attempt], int]:
    """Solve, let multipliers take over what the springs bear, and again. Collective.

    Where no contact has multipliers it is one solution.

    Args:
        equations: What is solved.
        iterate: A solution, by whether it is the first: its reason as SNES has it, and what was
            tried.
        load_before: External forces at this rank's unknowns in the committed state (force).

    Returns:
        Reason of the last solution, what was tried, and how many solutions there were.
    """
    augmented = [c for c in equations.contacts if c.multipliers is not None]
    if not augmented:
        return *iterate(True), 1
    _shrink(equations, load_before)
    attempts: list[Attempt] = []
    exact = False
    acceleration = Acceleration(equations.full.contacts, equations.full.scales)
    # The first solutions need not be better than the multipliers they are found with.
    equations.round_rtol = _FIRST_ROUND
    try:
        for number in range(1, _MAX_ROUNDS + 1):
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
            logger.debug("round %d: errors %s", number, errors)
            # Given displacements squeeze a body the less the softer the springs are, and there is
            # less friction: an overload is none before the multipliers bear what springs cannot.
            # Soft ones take over no more in a round than their stiffness by the bulk's of the rest.
            share = min(1.0, equations.stiffness_ratio()) if overload else 1.0
            if overload is not None:
                grows = max(errors) / share
                if grows < _SURELY * (overload.factor - 1.0) < np.inf:
                    break
            if worst <= share and (exact or overload):
                break
            exact = worst <= _NEARLY
            left = min((e for e in errors if e > 0), default=0.0)
            equations.round_rtol = 0.0 if exact else min(_FIRST_ROUND, INNER * left)
            if number < _MAX_ROUNDS and worst > share:
                acceleration.augment()
                if overload:  # what the load moved may be too far away to come back
                    equations.system.set_state(start)
    finally:
        equations.round_rtol = 0.0
    return reason, attempts, number


def _shrink(equations: Equations, load_before: Array) -> None:
    """Let λ_n begin with its share of a load that has fallen far. Collective.

    Multipliers of a load that was ten times as large leave contact to those few points where they
    are largest, and the rounds begin far from where they end, or nowhere. They are where rounds
    begin, and no part of the history.
    """
    full = equations.full
    sizes = full.by_body(full.load, load_before)
    for operator in full.operators:
        if operator.contact.multipliers is None:
            continue
        touched = np.zeros(full.n_bodies)
        touched[full.label[operator.touched]] = 1.0
        mine = global_sum(full.unknowns.comm, touched) > 0.0
        if not sizes[1, mine].any():  # bodies between others have no load of their own
            mine = np.isin(full.scales.group, full.scales.group[mine])
        now, before = (float(np.linalg.norm(size[mine])) for size in sizes)
        if _NOTHING * before < now < _FELL * before:
            operator.contact.multipliers.shrink(now / before)
            operator.contact.states.forget()


def _append(attempts: list[Attempt], tried: Sequence[Attempt]) -> None:
    """Add what was tried; the same with the same outcome once more counts iterations alone."""
    for attempt in tried:
        last = attempts[-1] if attempts else None
        if last and (last.method, last.outcome) == (attempt.method, attempt.outcome):
            attempts[-1] = replace(attempt, iterations=last.iterations + attempt.iterations)
        else:
            attempts.append(attempt)
