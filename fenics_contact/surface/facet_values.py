"""Extrapolation of values at quadrature points to the nodes of facets."""

from __future__ import annotations

import numpy as np

from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array, Mask

__all__ = ["facet_values"]


def facet_values(points: Array, measure: Array, values: Array, nodes: Array) -> Array:
    """Extrapolate point values to the nodes of facets without exceeding their range.

    On every facet a linear function is fitted by least squares; its slope is reduced until all
    nodal values are within the range of the point values. The mean, and so the force, is kept. If
    some values are NaN, the function is constant, the mean of the others.

    Args:
        points: Positions of the points, (n_facets, n_points, d).
        measure: Area of each point, (n_facets, n_points).
        values: Values at the points, (n_facets, n_points) or (n_facets, n_points, k).
        nodes: Positions of the nodes, (n_facets, n_nodes, d).

    Returns:
        Nodal values, (n_facets, n_nodes) or (n_facets, n_nodes, k).
    """
    shape = (*nodes.shape[:2], *values.shape[2:])
    values = values.reshape(*values.shape[:2], int(np.prod(values.shape[2:])))
    known: Mask = np.all(np.isfinite(values), axis=2)
    complete: Mask = np.all(known, axis=1)
    weight = np.where(known, measure, 0.0)
    total = weight.sum(axis=1, keepdims=True)
    weight = np.divide(weight, total, out=np.full_like(weight, np.nan), where=total > 0)
    filled = np.where(known[:, :, None], values, 0.0)
    mean = np.einsum("fp,fpk->fk", weight, filled)[:, None]
    weight = np.nan_to_num(weight)
    middle = np.einsum("fp,fpd->fd", weight, points)[:, None]
    root = np.sqrt(weight)[:, :, None]
    # The points of a facet are, nearly, in a plane: only its directions are used.
    _, size, directions = np.linalg.svd(root * (points - middle), full_matrices=False)
    size, directions = size[:, : points.shape[2] - 1], directions[:, : points.shape[2] - 1]
    determined = (size > FLAT * size[:, :1].clip(min=1e-300)) & complete[:, None]
    inverse = np.divide(1.0, size**2, out=np.zeros_like(size), where=determined)
    along = np.einsum("fpd,fwd->fpw", points - middle, directions)
    slope = np.einsum("fw,fpw,fp,fpk->fwk", inverse, along, weight, filled)
    change = np.einsum("fnd,fwd,fwk->fnk", nodes - middle, directions, slope)
    low, high = filled.min(axis=1, keepdims=True), filled.max(axis=1, keepdims=True)
    with np.errstate(over="ignore"):  # division by tiny changes
        bound = np.where(change > 0, high - mean, low - mean)
        bound = np.divide(bound, change, out=np.ones_like(change), where=np.abs(change) > 0)
    fraction = np.clip(bound.min(axis=1, keepdims=True), 0.0, 1.0)
    fitted = mean + fraction * change
    fitted[complete] = np.clip(fitted[complete], low[complete], high[complete])  # exactly
    return fitted.reshape(shape)
