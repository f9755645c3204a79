"""An opposing deformable body and the options of its pairing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import dolfinx
import dolfinx.geometry
import numpy as np

from fenics_contact.arguments import check_positive
from fenics_contact.obstacles.base import Obstacle

__all__ = ["DeformableBody"]


@dataclass(frozen=True)
class DeformableBody(Obstacle):
    """An opposing deformable body: another part of the same mesh and displacement space.

    Γc is the slave side, on which the contact law is integrated, and should be on the more finely
    meshed body, with equal meshes on the softer one; the surface of this body is the master side.
    The contact forces on both bodies are equal and opposite up to round-off.

    Args:
        facet_tags: Tags on the facets of the mesh.
        tags: Tag or tags of the opposing surface.
        search_distance: Largest distance of a point of Γc from its opposite point (length),
            infinite by default.
        update_pairs: Which points are opposite each other. "never": those of the undeformed bodies;
            points may slide by a facet at most. "increment": those of the deformed bodies at the
            end of each increment, which is solved again if points in contact have slid by more than
            a hundredth of their facet since pairs were found. "auto": likewise, from the first
            increment on in which a point in contact (any point, if none is in contact) has moved
            along the opposing surface, or without one, by more than its facet, or in which the
            small-displacement error of the contact force would be above 1 %. With
            ``ContactProblem(small_displacement_tolerance=inf)`` no increment is solved again, and
            pairs are those where it began. Normals remain those of the undeformed Γc. With
            `Contact(kinematics="finite")` pairs and normals are always those of the deformed
            bodies.
        max_initial_penetration: Largest depth (length) at which a point of Γc behind the opposing
            surface is paired in the undeformed bodies. By default the penetration of the two
            bodies; in self-contact half the height of the point's cell. In deformed bodies the
            limit is twice the present penetration.

    Raises:
        ValueError: A distance is negative or not a number, or ``update_pairs`` is unknown.
    """

    facet_tags: dolfinx.mesh.MeshTags
    tags: int | Sequence[int]
    search_distance: float = np.inf
    update_pairs: str = "auto"
    max_initial_penetration: float | None = None

    def __post_init__(self) -> None:
        """Check the arguments."""
        length = "a length greater than zero"
        check_positive("search_distance", self.search_distance, length, infinite=True)
        if self.update_pairs not in ("auto", "never", "increment"):
            raise ValueError(
                f"update_pairs is {self.update_pairs!r}; use 'auto', 'never' or 'increment'"
            )
        if self.max_initial_penetration is not None and not self.max_initial_penetration >= 0:
            raise ValueError(
                f"max_initial_penetration is {self.max_initial_penetration!r}; it must be a "
                "length, zero or greater"
            )

    def check_complete(self) -> None:
        """Accept the obstacle as complete: its position is found by a search."""
