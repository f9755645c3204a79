"""A deformable body as the obstacle: which it is, and how it is looked for."""

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
    """The obstacle is another part of the same mesh and displacement space.

    Γc should be the surface of the softer or more finely meshed body. Forces on both are equal and
    opposite to round-off.

    Args to the constructor:
        facet_tags: Tags on the facets of the mesh.
        tags: Tag, or tags, of the opposite surface.
        search_distance: Points whose opposite lies farther (length) than this have none; no limit
            by default.
        update_pairs: "never": the pairs are those of the undeformed bodies; "increment": they are
            found anew in the deformed bodies at every commit; "auto": likewise, from the first
            commit on at which a closed point, or where none is any, has moved along its opposite
            by more than its facet. Normals stay those of the undeformed Γc (small rotations). With
            `Contact(kinematics="finite")` they are those of the present bodies, whatever this says.
        max_initial_penetration: How far behind a point (length) its opposite may lie, where the
            bodies penetrate each other from the start. By default as far as they do, if they are
            two; in one and the same body half the height of the point's cell. In deformed bodies
            always twice as far as they penetrate there.
    """

    facet_tags: dolfinx.mesh.MeshTags
    tags: int | Sequence[int]
    search_distance: float = np.inf
    update_pairs: str = "auto"
    max_initial_penetration: float | None = None

    def __post_init__(self) -> None:
        """Refuse what has no sense."""
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
        """Its place is found by a search: nothing is missing."""
