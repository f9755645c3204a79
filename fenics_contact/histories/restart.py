"""The committed state of a problem as rows of numbers, from which another run continues."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from fenics_contact.checks.energy import EnergyState
from fenics_contact.parallel import global_max
from fenics_contact.problem import ContactProblem
from fenics_contact.state import State
from fenics_contact.systems.forces import Forces
from fenics_contact.types import Array

__all__ = ["N_ROWS", "at_state", "committed_rows", "continue_from_rows"]

# Rows of `committed_rows`.
N_ROWS = 7


def committed_rows(problem: ContactProblem) -> Array:
    """Return the committed state of the unknowns. Collective.

    The interior displacement is recovered first, if it is out of date.

    Returns:
        Array (N_ROWS, n_local) over this rank's unknowns: their values and last change (length);
        internal forces, external forces and the last change of the latter (force); masks of the
        unknowns retained by static condensation, and of those with Dirichlet conditions.

    Raises:
        ValueError: The present state is not that of the last commit, or another problem has
            committed a contact.
    """
    full, state = problem.full, problem.state
    state.check_contacts(problem.contacts)
    differs = problem.present.interior is not state.interior or not np.array_equal(
        full.state(), state.unknowns
    )
    if full.unknowns.comm.allreduce(int(differs)):
        raise ValueError(
            "u is not that of the last commit: an increment was not committed, or values of u "
            "were changed; call commit() or restore() before saving the state"
        )
    problem.complete()
    state, forces = problem.state, problem.state.energy.forces[full.coordinate_id]
    change = np.zeros_like(state.load) if state.change is None else state.change
    retained = np.zeros_like(state.load)
    if problem.solver.condensed:
        retained[problem.solver.system.unknowns.retained] = 1.0
    loads = [forces.internal, forces.external, state.load_change]
    return np.stack([state.unknowns, change, *loads, retained, full.constrained])


@contextmanager
def at_state(problem: ContactProblem, unknowns: Array) -> Iterator[None]:
    """Set the unknowns within a ``with`` block. Collective.

    With a linear bulk, stiffnesses that are multiples of E/h follow its present data within the
    block, as in `ContactProblem.solve`.
    """
    full, modulus = problem.full, problem.modulus
    before, measured = full.state(), modulus.present
    try:
        full.set_state(unknowns)
        if full.bulk.linear:
            modulus.measure()
        yield
    finally:
        full.set_state(before)
        modulus.restore(measured)


def continue_from_rows(
    problem: ContactProblem,
    rows: Array,
    numbers: Sequence[float] | Array,
    points: Sequence[tuple[Array, Mapping[str, Array]]],
) -> None:
    """Continue from the state that `committed_rows` returned in another run. Collective.

    The loads must be those of that state.

    Args:
        problem: The problem.
        rows: The state of the unknowns.
        numbers: Number of increments, `ContactProblem.expected_increments`, and for every contact
            whether its pairs are to be found again.
        points: History and values of every contact for `ContactStates.load_restart`.
    """
    unknowns, change, internal, external, load_change, retained, _ = rows
    increment, problem.expected_increments, *updates_pairs = (int(number) for number in numbers)
    full, contacts = problem.full, problem.contacts
    problem.solver.retain_dofs(np.flatnonzero(retained).astype(np.int32))
    full.set_state(unknowns)
    load = full.present_load()
    full.begin(load)
    for contact, (history, values), again in zip(contacts, points, updates_pairs, strict=True):
        contact.states.load_restart(history, values, updates_pairs=bool(again))
    forces = Forces(unknowns, internal, external, full.partition)
    energy = EnergyState.at({full.coordinate_id: forces}, contacts)
    state = State(
        unknowns=unknowns.copy(),
        contacts=tuple(contact.states.committed for contact in contacts),
        load=load,
        energy=energy.with_committed_jumps(contacts),
        change=change.copy() if global_max(full.unknowns.comm, np.abs(change)) else None,
        load_change=load_change.copy(),
        increment=increment,
    )
    problem.continue_from(state)
