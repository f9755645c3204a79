"""Sampling points on the facets of Γc besides the quadrature points, and their positions."""

from __future__ import annotations

from collections.abc import Callable

import basix
import numpy as np
from dolfinx import fem

from fenics_contact.compat import geometry_element
from fenics_contact.surface.crossings import MovingFacets
from fenics_contact.surface.facets import FacetSet, tabulate
from fenics_contact.surface.projection import polynomial_space
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array, Index

__all__ = ["FacetSampling"]


class FacetSampling:
    """Quadrature points, corners, edge midpoints and centres of the facets of Γc.

    The deformed Γc is given by its nodes: on each facet those of a Lagrange element of the degree
    of displacement and geometry. The constructor is collective.

    Args:
        space: The displacement space.
        x: Undeformed positions of this rank's points, (n_points, gdim) (length).

    Attributes:
        facets: Γc as a set of facets.
        rows: The points of every facet of this rank, (n_facets, n_points_per_facet).
        facet: Facet of this rank of every place, (n,); quadrature points first, ordered as `rows`.
        reference: Reference coordinates of every place on its facet, (n, gdim - 1).
        size: Length of every facet of this rank, in 3D the root of its area, (n_facets,) (length).
        points_determine_nodes: Whether displacement and geometry at the quadrature points of a
            facet determine those at its nodes.
    """

    def __init__(self, quadrature: SurfaceQuadrature, space: fem.FunctionSpace, x: Array) -> None:
        self.facets = FacetSet(space, quadrature.surface.facets)
        self.rows = quadrature.point_rows
        n_facets, n_points = self.rows.shape
        self.size = quadrature.facet_sizes[self.rows[:, 0]]
        facet = np.repeat(np.arange(n_facets), n_points)
        at = self.facets.locate(facet, x[self.rows.ravel()])
        facets, lattice = self.facets.lattice()
        self.facet, self.reference = np.append(facet, facets), np.concatenate([at, lattice])
        degree = max(space.ufl_element().degree, geometry_element(space.mesh).degree)
        self._pieces = self.facets.flat_pieces(degree)
        self._element = basix.create_element(
            basix.ElementFamily.P, self.facets.kind, degree, basix.LagrangeVariant.gll_warped
        )
        self._nodes = self.facets.combine(self._element.points)
        # The degree is limited to that of geometry and displacement: more points are fitted.
        basis = polynomial_space(self.facets.kind, min(n_points, self._element.dim))
        table = tabulate(basis, 0, at)[0, :, :, 0].reshape(n_facets, n_points, basis.dim)
        self._fit = tabulate(basis, 0, self._element.points)[0, :, :, 0] @ np.linalg.pinv(table)
        self.points_determine_nodes = basis.dim == self._element.dim

    def at_nodes(
        self, points: Array, u: fem.Function | None, rotate: Callable[[Array], Array]
    ) -> Array:
        """Compute the positions of the nodes from those of the quadrature points.

        Only what the points do not determine is evaluated from u: round-off would move plane facets
        off the surfaces that they touch.

        Args:
            points: Positions of this rank's points in a moving frame, (n_points, gdim) (length).
            u: Displacement; None: its part not determined by the points is neglected.
            rotate: Rotation of vectors (n, gdim) to that frame.

        Returns:
            Positions, (n_nodes, gdim) (length).
        """
        rows = points[self.rows]
        positions = self._fit @ rows
        if not self.points_determine_nodes:
            own = slice(self.rows.size)
            start, _ = self.facets.positions(self.facet[own], self.reference[own], u)
            remainder, _ = self.facets.positions(*self._nodes, u)
            remainder -= (self._fit @ start.reshape(rows.shape)).reshape(remainder.shape)
            positions += rotate(remainder).reshape(positions.shape)
        return positions.reshape(-1, points.shape[1])

    def values(self, field: Array, facet: Index, reference: Array) -> Array:
        """Interpolate a field, given at the nodes of `at_nodes`, at points on facets, (n, gdim).

        Args:
            field: Values at this rank's nodes, (n_nodes, gdim).
            facet: Facet of this rank of every point, (n,).
            reference: Reference coordinates on it, (n, gdim - 1).
        """
        table = tabulate(self._element, 0, reference)[0, :, :, 0]
        return np.asarray(np.einsum("nk,nkd->nd", table, self._by_facet(field)[facet]))

    def _by_facet(self, field: Array) -> Array:
        """Group a nodal field by facets, (n_facets, n_nodes_per_facet, gdim)."""
        return field.reshape(-1, self._element.dim, field.shape[1])

    def tangents(self, field: Array) -> Array:
        """Return edge vectors of all facets, (n_facets, gdim, gdim - 1), for nodes at ``field``."""
        corners = self._by_facet(field)[:, : field.shape[1]]  # the first nodes
        return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)

    def outward(self, field: Array) -> Array:
        """Return outward unit normals at the first corners of all facets, (n_facets, gdim)."""
        facets = np.arange(len(self.size))
        return self.facets.outward_normals(facets, self.tangents(field))

    def moving_facets(self, start: Array, end: Array) -> MovingFacets:
        """Return the flat pieces of facets whose nodes move from ``start`` to ``end``."""
        n_pieces, n_corners, _ = self._pieces.shape
        table = tabulate(self._element, 0, np.concatenate(self._pieces))[0, :, :, 0]
        first, last = (
            (table @ self._by_facet(nodes)).reshape(-1, n_corners, nodes.shape[1])
            for nodes in (start, end)
        )
        vertices = np.repeat(self.facets.vertices(), n_pieces, axis=0)
        sign = np.repeat(self.facets.outward, n_pieces)
        return MovingFacets(first, last, sign, vertices)

    def piece_deviations(self, field: Array) -> Array:
        """Return the distance of every flat piece from its facet at its centre, (n,) (length)."""
        nodes, centres = self._by_facet(field), self._pieces.mean(axis=1)
        curved = tabulate(self._element, 0, centres)[0, :, :, 0] @ nodes
        corners = tabulate(self._element, 0, np.concatenate(self._pieces))[0, :, :, 0] @ nodes
        flat = corners.reshape(len(nodes), *self._pieces.shape[:2], field.shape[1]).mean(axis=2)
        return np.asarray(np.linalg.norm(curved - flat, axis=2).ravel())

    def piece_centres(self) -> Array:
        """Return the centres of the facets' flat pieces on the undeformed Γc, (n, gdim)."""
        return self.facets.positions(*self.facets.combine(self._pieces.mean(axis=1)))[0]
