"""Places on the facets of Γc between its quadrature points, and where they are displaced to."""

from __future__ import annotations

from collections.abc import Callable

import basix
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

    A displaced Γc is given by the positions of its nodes, those of a Lagrange element on each facet
    that has the degree of displacement and geometry; there may be other numbers of them than of
    quadrature points. The constructor is collective.

    Args:
        space: The displacement space.
        x: Undeformed places of this rank's points, (n_points, gdim) (length).

    Attributes:
        facets: Γc as a set of facets.
        rows: The points of every facet of this rank, (n_facets, n_points_per_facet).
        facet: Facet of this rank of every place, (n,), the points first, in the order of `rows`.
        reference: Reference coordinates of every place on its facet, (n, gdim - 1).
        size: Length of every facet of this rank, in space the root of its area, (n_facets,)
            (length).
        points_carry_nodes: Whether displacement and geometry at the quadrature points of a facet
            determine those at its nodes.
    """

    def __init__(self, quadrature: SurfaceQuadrature, space: fem.FunctionSpace, x: Array) -> None:
        self.facets = FacetSet(space, quadrature.surface.facets)
        self.rows = quadrature.point_rows
        n_facets, n_points = self.rows.shape
        self.size = quadrature.facet_sizes[self.rows[:, 0]]
        facet = np.repeat(np.arange(n_facets), n_points)
        at = self.facets.locate(facet, x[self.rows.ravel()])
        more, corners = self.facets.lattice()
        self.facet, self.reference = np.append(facet, more), np.concatenate([at, corners])
        degree = max(space.ufl_element().degree, geometry_element(space.mesh).degree)
        self._pieces = self.facets.flat_pieces(degree)
        self._element = basix.create_element(
            basix.ElementFamily.P, self.facets.kind, degree, basix.LagrangeVariant.gll_warped
        )
        self._nodes = self.facets.each(self._element.points)
        # No higher degree than that of geometry and displacement: many points are fitted then.
        basis = polynomials(self.facets.kind, min(n_points, self._element.dim))
        table = tabulate(basis, 0, at)[0, :, :, 0].reshape(n_facets, n_points, basis.dim)
        self._fit = tabulate(basis, 0, self._element.points)[0, :, :, 0] @ np.linalg.pinv(table)
        self.points_carry_nodes = basis.dim == self._element.dim

    def at_nodes(
        self, points: Array, u: fem.Function | None, turned: Callable[[Array], Array]
    ) -> Array:
        """Positions of the nodes in a frame in which those of the points are known.

        What the points do not carry of geometry and displacement is added. What they do is not
        evaluated from u: round-off would move plane facets off the surfaces that they touch.

        Args:
            points: Of this rank, displaced and moved rigidly, (n_points, gdim) (length).
            u: The displacement; None: what the points do not carry of it is left out.
            turned: The rotation in that motion, of (n, gdim).

        Returns:
            (n_nodes, gdim) (length).
        """
        rows = points[self.rows]
        found = self._fit @ rows
        if not self.points_carry_nodes:
            mine = slice(self.rows.size)
            start, _ = self.facets.positions(self.facet[mine], self.reference[mine], u)
            rest, _ = self.facets.positions(*self._nodes, u)
            rest -= (self._fit @ start.reshape(rows.shape)).reshape(rest.shape)
            found += turned(rest).reshape(found.shape)
        return found.reshape(-1, points.shape[1])

    def values(self, field: Array, facet: Index, reference: Array) -> Array:
        """A field at places on facets.

        Args:
            field: At this rank's nodes, (n_nodes, gdim); see `at_nodes`.
            facet: Facet of this rank of every place, (n,).
            reference: Reference coordinates on it, (n, gdim - 1).

        Returns:
            (n, gdim), in the unit of the field.
        """
        table = tabulate(self._element, 0, reference)[0, :, :, 0]
        return np.asarray(np.einsum("nk,nkd->nd", table, self._by_facet(field)[facet]))

    def _by_facet(self, field: Array) -> Array:
        """A field at the nodes, facet by facet, (n_facets, n_nodes_per_facet, gdim)."""
        return field.reshape(-1, self._element.dim, field.shape[1])

    def tangents(self, field: Array) -> Array:
        """Edges of all facets, (n_facets, gdim, gdim - 1) (length); ``field`` as in `values`."""
        corners = self._by_facet(field)[:, : field.shape[1]]  # the first nodes
        return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)

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
        n_pieces, n_corners, _ = self._pieces.shape
        table = tabulate(self._element, 0, np.concatenate(self._pieces))[0, :, :, 0]
        first, last = (
            (table @ self._by_facet(nodes)).reshape(-1, n_corners, nodes.shape[1])
            for nodes in (start, end)
        )
        vertices = np.repeat(self.facets.vertices(), n_pieces, axis=0)
        sign = np.repeat(self.facets.outward, n_pieces)
        return MovingFacets(first, last, sign, vertices)

    def piece_middles(self) -> Array:
        """Where the middles of the facets' flat pieces are on the undeformed Γc, (n, gdim)."""
        return self.facets.positions(*self.facets.each(self._pieces.mean(axis=1)))[0]
