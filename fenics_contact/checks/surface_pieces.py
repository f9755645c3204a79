"""The flat pieces of Γc on all ranks, and the depth of points below them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from fenics_contact.checks.penetration import DEPTH_RESOLUTION, OPPOSITE_SIDES
from fenics_contact.parallel import gather_rows
from fenics_contact.surface.crossings import MovingFacets, find_crossings
from fenics_contact.surface.facet_sampling import FacetSampling
from fenics_contact.types import Array, Index, Mask

__all__ = ["SurfacePieces", "depth_below_surface"]

# Cosine of the angle between the normals of two faces that meet at an edge: 60 degrees and more.
_EDGE_COSINE = 0.5


@dataclass(frozen=True)
class SurfacePieces:
    """The flat pieces of Γc, n on all ranks.

    Attributes:
        comm: Communicator.
        facets: This rank's pieces, at rest.
        allowed: Allowed depth below each piece, with the deviation of its facet from it, (n,)
            (length).
        size: Size of the facet of each piece, (n,) (length).
        corner: First corner of each piece, (n, gdim) (length).
        normal: Outward unit normals, (n, gdim).
        middle: Midpoints on the undeformed Γc, (n, gdim) (length).
    """

    comm: MPI.Comm
    facets: MovingFacets
    allowed: Array
    size: Array
    corner: Array
    normal: Array
    middle: Array

    @classmethod
    def of(
        cls, comm: MPI.Comm, places: FacetSampling, field: Array, facet: Index, allowed: Array
    ) -> SurfacePieces:
        """Gather the pieces of all ranks. Collective.

        The nodes of Γc are at ``field``, (n_nodes, gdim) (length). ``allowed`` has the allowed
        depth at positions on ``facet``, (n,) (length).
        """
        bound: Array = np.zeros(len(places.size))
        np.maximum.at(bound, facet, allowed)
        facets, middles = places.moving_facets(field, field), places.piece_centres()
        n_pieces = len(middles) // max(len(bound), 1)
        bound = np.repeat(bound, n_pieces) + places.piece_deviations(field)
        size = np.repeat(places.size, n_pieces)
        table = np.column_stack([bound, size, facets.start[:, 0], facets.normals(), middles])
        table = gather_rows(comm, table)
        fields = np.split(table[:, 2:], 3, axis=1)
        return cls(comm, facets, table[:, 0], table[:, 1], *fields)

    def is_shallow(self, points: Array, normal: Array) -> Mask:
        """Return whether points are within the allowed depth below an adjacent face. Collective.

        Near an edge of the body a point deep below one facet, with the outward unit ``normal``, may
        have hardly entered through the other one. Faces opposite to the facet do not count.
        """
        depth = -np.einsum("nmd,md->nm", points[:, None] - self.corner, self.normal)
        near = (depth >= 0) & (depth <= self.allowed)
        cosine = normal @ self.normal.T
        row, facet = np.nonzero(near & (cosine > OPPOSITE_SIDES) & (cosine < _EDGE_COSINE))
        reach = 2 * depth[row, facet] + DEPTH_RESOLUTION * self.allowed[facet]
        outward = self.normal[facet]
        _, facet_above = depth_below_surface(self.comm, points[row], outward, reach, self.facets)
        shallow = np.zeros(len(points), dtype=np.bool_)
        shallow[row[facet_above == facet]] = True
        return shallow


def depth_below_surface(
    comm: MPI.Comm, points: Array, outward: Array, reach: Array, facets: MovingFacets
) -> tuple[Array, Index]:
    """Return the depth of points below Γc, along given directions. Collective.

    Args:
        comm: Communicator.
        points: Positions, (n, gdim) (length).
        outward: Unit vectors along which Γc is searched, (n, gdim).
        reach: Length of the search, (n,) (length).
        facets: Γc, at rest.

    Returns:
        The depth, (n,) (length), and the global number of the facet, (n,), -1 for points that are
        not below Γc.
    """
    vertices, end = np.full((len(points), 1), -1), points + reach[:, None] * outward
    hits = find_crossings(comm, points, end, vertices, facets)
    first = np.append(True, np.diff(hits.place) > 0)[: len(hits.place)] & ~hits.inward
    place, depth, facet = hits.place[first], np.zeros(len(points)), np.full(len(points), -1)
    depth[place], facet[place] = hits.time[first] * reach[place], hits.facet[first]
    return depth, facet
