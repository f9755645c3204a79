"""Places on the facets of Γc between its quadrature points, and point fields evaluated there."""

from __future__ import annotations

import numpy as np
from dolfinx import fem

from fenics_contact.compat import geometry_element
from fenics_contact.surface.crossings import MovingFacets
from fenics_contact.surface.facets import FacetSet, tabulate
from fenics_contact.surface.projection import polynomials
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array, Index

__all__ = ["FacetPlaces"]


class FacetPlaces:
    """The points of Γc, and corners, middles of edges and middles of its facets.

    A field that is known at the quadrature points is evaluated elsewhere on a facet by the
    polynomial that its points carry: exactly, where it is of the degree of the displacement.

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
        self.rows = quadrature.point_rows()
        n_facets, n_points = self.rows.shape
        d = space.mesh.geometry.dim
        self.size = quadrature.weights[self.rows].sum(axis=1) ** (1.0 / (d - 1))
        facet = np.repeat(np.arange(n_facets), n_points)
        normal = self.facets.mean_normals()
        at, *_ = self.facets.meet(facet, x[self.rows.ravel()], normal[facet])
        more, corners = self.facets.lattice()
        self.facet, self.reference = np.append(facet, more), np.concatenate([at, corners])
        # No higher degree than that of geometry and displacement: many points are fitted then.
        degree = max(space.ufl_element().degree, geometry_element(space.mesh).degree)
        n_basis = (degree + 1) ** (d - 1)
        if d == 3 and self.facets.simplex:
            n_basis = (degree + 1) * (degree + 2) // 2
        self._basis = polynomials(d, self.facets.simplex, min(n_points, n_basis))
        table = tabulate(self._basis, 0, at)[0, :, :, 0]
        table = table.reshape(n_facets, n_points, self._basis.dim)
        self._pieces = self.facets.flat_pieces(degree)
        self._coefficients = np.linalg.pinv(table) if n_facets else table.swapaxes(1, 2)

    def values(self, field: Array, facet: Index, reference: Array) -> Array:
        """A point field at places on facets.

        Args:
            field: At this rank's points, (n_points, ...).
            facet: Facet of this rank of every place, (n,).
            reference: Reference coordinates on it, (n, gdim - 1).

        Returns:
            (n, ...), in the unit of the field.
        """
        table = tabulate(self._basis, 0, reference)[0, :, :, 0]
        weights = np.einsum("nb,nbq->nq", table, self._coefficients[facet])
        return np.asarray(np.einsum("nq,nq...->n...", weights, field[self.rows[facet]]))

    def moving_facets(self, start: Array, end: Array) -> MovingFacets:
        """The facets of this rank, in flat pieces, whose points move from a start to an end.

        Args:
            start: Of this rank's points, (n_points, gdim) (length).
            end: Of this rank's points, (n_points, gdim) (length).
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
