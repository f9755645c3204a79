"""Linear programmes of free motions: few coefficients, and a row for every gap."""

from __future__ import annotations

import numpy as np
import scipy.optimize

from fenics_contact.types import Array

__all__ = ["least_sum", "linear_programme"]


def linear_programme(cost: Array, matrix: Array, limit: Array) -> Array | None:
    """Minimise cost @ x where matrix @ x <= limit; None: there is no such x, or no least cost.

    Args:
        cost: (n,).
        matrix: (n_rows, n).
        limit: (n_rows,).
    """
    found = scipy.optimize.linprog(
        cost,
        A_ub=matrix,
        b_ub=limit,
        bounds=(None, None),
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    return found.x if found.status == 0 else None


def least_sum(matrix: Array, limit: Array, terms: Array, offset: Array) -> Array | None:
    """Minimise the sum of the sizes of offset + terms @ x where matrix @ x <= limit.

    Args:
        matrix: (n_rows, n).
        limit: (n_rows,).
        terms: (n_terms, n).
        offset: (n_terms,).

    Returns:
        Array (n,); None: there is no such x.
    """
    n, unit = terms.shape[1], np.eye(len(terms))
    rows = [
        np.hstack([matrix, np.zeros((len(matrix), len(terms)))]),
        np.hstack([terms, -unit]),
        np.hstack([-terms, -unit]),
    ]
    cost = np.concatenate([np.zeros(n), np.ones(len(terms))])
    ends = np.concatenate([limit, -offset, offset])
    found = linear_programme(cost, np.concatenate(rows), ends)
    return None if found is None else found[:n]
