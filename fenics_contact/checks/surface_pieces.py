"""The flat pieces of Γc on all ranks, and how deep points are below them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from fenics_contact.checks.penetration import DEPTH_RESOLUTION, OPPOSITE_SIDES
from fenics_contact.parallel import gather_rows
from fenics_contact.surface.crossings import MovingFacets, find_crossings
from fenics_contact.surface.facet_places import FacetPlaces
from fenics_contact.types import Array, Index, Mask

__all__ = ["SurfacePieces", "depth_below_surface"]

# Cosine of the angle between the normals of two faces that meet at an edge: 60 degrees and more.
_EDGE = 0.5


@dataclass(frozen=True)
class SurfacePieces:
    """The flat pieces of Γc.

    Attributes:
        comm: The ranks.
        facets: Those of this rank, at rest.
        allowed: Allowed depth below each of all, (n,) (length).
        corner: Its first corner, (n, gdim) (length).
        normal: Its outward unit normal, (n, gdim).
        middle: Its middle on the undeformed Γc, (n, gdim) (length).
    """

    comm: MPI.Comm
    facets: MovingFacets
    allowed: Array
    corner: Array
    normal: Array
    middle: Array

    @classmethod
    def of(
        cls, comm: MPI.Comm, places: FacetPlaces, field: Array, facet: Index, allowed: Array
    ) -> SurfacePieces:
        """Collect them on all ranks. Collective.

        Args:
            comm: The ranks.
            places: Of Γc.
            field: The nodes of Γc, (n_nodes, gdim) (length).
            facet: Facet of this rank of some places, (n,).
            allowed: Allowed depth at these, (n,) (length).
        """
        most: Array = np.zeros(len(places.size))
        np.maximum.at(most, facet, allowed)
        facets, middles = places.moving_facets(field, field), places.piece_middles()
        most = np.repeat(most, len(middles) // max(len(most), 1))
        table = np.column_stack([most, facets.start[:, 0], facets.normals(), middles])
        table = gather_rows(comm, table)
        return cls(comm, facets, table[:, 0], *np.split(table[:, 1:], 3, axis=1))

    def is_shallow(self, points: Array, normal: Array) -> Mask:
        """Find points that are no deeper below another face than is allowed there. Collective.

        At an edge of the body what is deep below one face may have hardly entered the other one.
        Faces opposite to the first one do not count: what is close to them has gone through.

        Args:
            points: (n, gdim) (length).
            normal: Outward unit normal of the facet that each is deep below, (n, gdim).
        """
        depth = -np.einsum("nmd,md->nm", points[:, None] - self.corner, self.normal)
        near = (depth >= 0) & (depth <= self.allowed)
        cosine = normal @ self.normal.T
        row, facet = np.nonzero(near & (cosine > OPPOSITE_SIDES) & (cosine < _EDGE))
        reach = 2 * depth[row, facet] + DEPTH_RESOLUTION * self.allowed[facet]
        outward = self.normal[facet]
        _, met = depth_below_surface(self.comm, points[row], outward, reach, self.facets)
        found = np.zeros(len(points), dtype=np.bool_)
        found[row[met == facet]] = True
        return found


def depth_below_surface(
    comm: MPI.Comm, points: Array, outward: Array, reach: Array, facets: MovingFacets
) -> tuple[Array, Index]:
    """How deep points are below Γc, along outward directions. Collective.

    Beside Γc a point is below none of its facets.

    Args:
        comm: The ranks.
        points: (n, gdim) (length).
        outward: Unit vectors, (n, gdim).
        reach: How far Γc is looked for, (n,) (length).
        facets: Γc, at rest.

    Returns:
        The depth, (n,) (length), and the number of the facet among those of all ranks, (n,), -1
        for points that are not below Γc.
    """
    vertices, end = np.full((len(points), 1), -1), points + reach[:, None] * outward
    met = find_crossings(comm, points, end, vertices, facets)
    first = np.append(True, np.diff(met.place) > 0)[: len(met.place)] & ~met.inward
    place, depth, facet = met.place[first], np.zeros(len(points)), np.full(len(points), -1)
    depth[place], facet[place] = met.time[first] * reach[place], met.facet[first]
    return depth, facet
