"""Linear functions on facets that values at their quadrature points make."""

from __future__ import annotations

import numpy as np

from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array, Mask

__all__ = ["facet_values"]


def facet_values(points: Array, measure: Array, values: Array, nodes: Array) -> Array:
    """Values at nodes of facets from those at points in them, within what the points have.

    On every facet the linear function that fits the values at its points best, flattened about
    their mean until none of its nodes is above the largest or below the smallest of them: no
    pressure where none of the points has any, no pull where none pulls, and the mean, with it the
    force, is that of the points. Where some of the values are NaN it is the mean of the others.

    Args:
        points: Places, (n_facets, n_points, d).
        measure: Area that each stands for, (n_facets, n_points).
        values: At the points, (n_facets, n_points) or (n_facets, n_points, k).
        nodes: Places, (n_facets, n_nodes, d).

    Returns:
        (n_facets, n_nodes) or (n_facets, n_nodes, k).
    """
    shape = (*nodes.shape[:2], *values.shape[2:])
    values = values.reshape(*values.shape[:2], int(np.prod(values.shape[2:])))
    known: Mask = np.all(np.isfinite(values), axis=2)
    whole: Mask = np.all(known, axis=1)
    share = np.where(known, measure, 0.0)
    total = share.sum(axis=1, keepdims=True)
    share = np.divide(share, total, out=np.full_like(share, np.nan), where=total > 0)
    filled = np.where(known[:, :, None], values, 0.0)
    mean = np.einsum("fp,fpk->fk", share, filled)[:, None]
    share = np.nan_to_num(share)
    middle = np.einsum("fp,fpd->fd", share, points)[:, None]
    root = np.sqrt(share)[:, :, None]
    # Along the facet alone: its points, and those of a curved one nearly, are in a plane.
    _, size, ways = np.linalg.svd(root * (points - middle), full_matrices=False)
    size, ways = size[:, : points.shape[2] - 1], ways[:, : points.shape[2] - 1]
    used = (size > FLAT * size[:, :1].clip(min=1e-300)) & whole[:, None]
    inverse = np.divide(1.0, size**2, out=np.zeros_like(size), where=used)
    along = np.einsum("fpd,fwd->fpw", points - middle, ways)
    slope = np.einsum("fw,fpw,fp,fpk->fwk", inverse, along, share, filled)
    change = np.einsum("fnd,fwd,fwk->fnk", nodes - middle, ways, slope)
    # How much of the change the range of the points allows, by facet and component.
    low, high = filled.min(axis=1, keepdims=True), filled.max(axis=1, keepdims=True)
    with np.errstate(over="ignore"):  # of changes next to nothing
        room = np.where(change > 0, high - mean, low - mean)
        room = np.divide(room, change, out=np.ones_like(change), where=np.abs(change) > 0)
    allowed = np.clip(room.min(axis=1, keepdims=True), 0.0, 1.0)
    fitted = mean + allowed * change
    fitted[whole] = np.clip(fitted[whole], low[whole], high[whole])  # to the last digit
    return fitted.reshape(shape)
