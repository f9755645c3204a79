"""An opposing deformable body: its surface, and how pairs of points are found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import dolfinx
import dolfinx.geometry
import numpy as np

from fenics_contact.arguments import is_number
from fenics_contact.obstacles.base import Obstacle

__all__ = ["DeformableBody"]


@dataclass(frozen=True)
class DeformableBody(Obstacle):
    """An opposing deformable body: another part of the same mesh and displacement space.

    Γc should be on the softer or more finely meshed body. Contact forces on both bodies are equal
    and opposite up to round-off.

    Args:
        facet_tags: Tags on the facets of the mesh.
        tags: Tag or tags of the opposite surface.
        search_distance: Largest distance of an opposite point (length), infinite by default.
        update_pairs: When pairs of points are found again. "never": the pairs are those of the
            undeformed bodies. "increment": at every commit, in the deformed bodies. "auto": at
            every commit from the first one at which a closed point has moved along the opposite
            surface by more than its facet (any point, if none is closed). Normals remain those of
            the undeformed Γc. With `Contact(kinematics="finite")` pairs and normals are always
            those of the deformed bodies.
        max_initial_penetration: Largest depth of a point of Γc behind its opposite point in the
            undeformed bodies (length). By default the penetration of the two bodies; within one
            body, half the height of the point's cell. In deformed bodies it is twice the present
            penetration.

    Raises:
        ValueError: A distance is negative or no number, or ``update_pairs`` is unknown.
    """

    facet_tags: dolfinx.mesh.MeshTags
    tags: int | Sequence[int]
    search_distance: float = np.inf
    update_pairs: str = "auto"
    max_initial_penetration: float | None = None

    def __post_init__(self) -> None:
        """Check the arguments."""
        if not (is_number(self.search_distance) and self.search_distance > 0):
            raise ValueError(
                f"search_distance is {self.search_distance!r}; it must be a length greater "
                "than zero"
            )
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
