"""Places on the facets of Γc between its quadrature points, and point fields evaluated there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from dolfinx import fem

from fenics_contact.compat import geometry_element
from fenics_contact.surface.crossings import MovingFacets
from fenics_contact.surface.facets import FacetSet, tabulate
from fenics_contact.surface.projection import polynomials
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array, Index

__all__ = ["FacetPlaces"]


@dataclass(frozen=True)
class _Interpolation:
    """Polynomials on facets through values at nodes.

    Attributes:
        rows: Nodes of every facet of this rank, (n_facets, n).
        basis: Of the polynomials.
        coefficients: From the values at the nodes, (n_facets, n_basis, n).
    """

    rows: Index
    basis: Any
    coefficients: Array

    @classmethod
    def of(cls, facets: FacetSet, rows: Index, at: Array, n_basis: int) -> _Interpolation:
        """The largest complete ones, of ``n_basis`` functions at most, that the nodes can carry.

        Args:
            facets: The facets.
            rows: See the attribute.
            at: Reference coordinates of the nodes, in the order of ``rows``, (rows.size, gdim - 1).
            n_basis: See above.
        """
        n_facets, n = rows.shape
        basis = polynomials(facets.kind, min(n, n_basis))
        table = tabulate(basis, 0, at)[0, :, :, 0].reshape(n_facets, n, basis.dim)
        coefficients = np.linalg.pinv(table) if n_facets else table.swapaxes(1, 2)
        return cls(rows, basis, np.asarray(coefficients, dtype=np.float64))

    def __call__(self, field: Array, facet: Index, reference: Array) -> Array:
        """A field at the nodes, (n_nodes, ...), at places on facets: (n, ...)."""
        table = tabulate(self.basis, 0, reference)[0, :, :, 0]
        weights = np.einsum("nb,nbq->nq", table, self.coefficients[facet])
        return np.asarray(np.einsum("nq,nq...->n...", weights, field[self.rows[facet]]))


class FacetPlaces:
    """The points of Γc, and corners, middles of edges and middles of its facets.

    A field is evaluated on a facet by the polynomial that its nodes carry, which is of the degree
    of displacement and geometry. The nodes are the quadrature points where there are enough of
    them, else a lattice (`at_nodes`).

    Attributes:
        facets: Γc as a set of facets.
        rows: The points of every facet of this rank, (n_facets, n_points_per_facet).
        facet: Facet of this rank of every place, (n,), the points first, in the order of `rows`.
        reference: Reference coordinates of every place on its facet, (n, gdim - 1).
        size: Length of every facet of this rank, in space the root of its area, (n_facets,)
            (length).
    """

    def __init__(self, quadrature: SurfaceQuadrature, space: fem.FunctionSpace, x: Array) -> None:
        """Locate the points on their facets. Collective.

        Args:
            quadrature: The points of Γc.
            space: Of the displacement.
            x: Undeformed places of this rank's points, (n_points, gdim) (length).
        """
        self.facets = FacetSet(space, quadrature.surface.facets)
        self.rows = quadrature.point_rows
        n_facets, n_points = self.rows.shape
        self.size = quadrature.facet_sizes[self.rows[:, 0]]
        facet = np.repeat(np.arange(n_facets), n_points)
        at = self.facets.locate(facet, x[self.rows.ravel()])
        more, corners = self.facets.lattice()
        self.facet, self.reference = np.append(facet, more), np.concatenate([at, corners])
        # No higher degree than that of geometry and displacement: many points are fitted then.
        degree = max(space.ufl_element().degree, geometry_element(space.mesh).degree)
        lattice = self.facets.interpolation_nodes(degree)
        n_basis = len(lattice)
        self._at_points = _Interpolation.of(self.facets, self.rows, at, n_basis)
        self._nodes, self._at_nodes = self.reference[:0], self._at_points
        if n_points < n_basis:
            rows = np.arange(n_facets * len(lattice)).reshape(n_facets, len(lattice))
            self._nodes = np.tile(lattice, (n_facets, 1))
            self._at_nodes = _Interpolation.of(self.facets, rows, self._nodes, n_basis)
        self._pieces = self.facets.flat_pieces(degree)

    def at_nodes(
        self, field: Array, u: fem.Function | None, turned: Callable[[Array], Array]
    ) -> Array:
        """Places that are known at the points, at the nodes.

        What fewer points than nodes do not carry of geometry and displacement is added.

        Args:
            field: Places of this rank's points, displaced and moved rigidly, (n_points, gdim)
                (length).
            u: The displacement; None: what the points do not carry of it is left out.
            turned: The rotation in that motion, of (n, gdim).

        Returns:
            (n_nodes, gdim) (length); the field itself where the points are the nodes.
        """
        if self.points_are_nodes:
            return field
        facet = np.repeat(np.arange(len(self.rows)), self._at_nodes.rows.shape[1])
        mine = slice(self.rows.size)
        places = np.empty_like(field)
        places[self.rows.ravel()], _ = self.facets.positions(
            self.facet[mine], self.reference[mine], u
        )
        rest, _ = self.facets.positions(facet, self._nodes, u)
        rest -= self._at_points(places, facet, self._nodes)
        return self._at_points(field, facet, self._nodes) + turned(rest)

    @property
    def points_are_nodes(self) -> bool:
        """Whether the quadrature points carry displacement and geometry."""
        return self._at_nodes is self._at_points

    def values(self, field: Array, facet: Index, reference: Array) -> Array:
        """A field at places on facets.

        Args:
            field: At this rank's nodes, (n_nodes, ...); see `at_nodes`.
            facet: Facet of this rank of every place, (n,).
            reference: Reference coordinates on it, (n, gdim - 1).

        Returns:
            (n, ...), in the unit of the field.
        """
        return self._at_nodes(field, facet, reference)

    def tangents(self, field: Array) -> Array:
        """Edges of all facets, (n_facets, gdim, gdim - 1) (length); ``field`` as in `values`."""
        n, d = len(self.size), field.shape[1]
        origin, *ends = (
            self.values(field, np.arange(n), np.broadcast_to(unit, (n, d - 1)))
            for unit in np.vstack([np.zeros(d - 1), np.eye(d - 1)])
        )
        return np.stack([end - origin for end in ends], axis=2)

    def outward(self, field: Array) -> Array:
        """Outward unit normals at the first corners of all facets, (n_facets, gdim)."""
        every = np.arange(len(self.size))
        return self.facets.outward_normals(every, self.tangents(field))

    def moving_facets(self, start: Array, end: Array) -> MovingFacets:
        """The facets of this rank, in flat pieces, whose nodes move from a start to an end.

        Args:
            start: Of this rank's nodes, (n_nodes, gdim) (length).
            end: Of this rank's nodes, (n_nodes, gdim) (length).
        """
        n, (n_pieces, n_corners, _) = len(self.rows), self._pieces.shape[:3]
        facet = np.repeat(np.arange(n), n_pieces * n_corners)
        at = np.tile(np.concatenate(self._pieces), (n, 1))
        first, last = (
            self.values(points, facet, at).reshape(n * n_pieces, n_corners, points.shape[1])
            for points in (start, end)
        )
        vertices = np.repeat(self.facets.vertices(), n_pieces, axis=0)
        sign = np.repeat(self.facets.outward, n_pieces)
        return MovingFacets(first, last, sign, vertices)

    def piece_middles(self) -> Array:
        """Where the middles of the facets' flat pieces are on the undeformed Γc, (n, gdim)."""
        n, middles = len(self.rows), self._pieces.mean(axis=1)
        facet = np.repeat(np.arange(n), len(middles))
        return self.facets.positions(facet, np.tile(middles, (n, 1)))[0]
