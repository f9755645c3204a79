"""Whether points of Γc have gone through a rigid support, to its other side."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from dolfinx import fem

from fenics_contact.parallel import collective_errors
from fenics_contact.supports.base import Placement, SampledSupport
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.types import Array, Mask

__all__ = ["Passage"]


# Places looked at between both ends of a way.
_PLACES = 7
# Of a way, by how much it is deeper in the support between its ends than at these.
_DEEPER = 0.1


class Passage:
    """Of the ways of points, seen from a support; compiled when first needed.

    In an increment a point goes straight on, as does the support, which turns evenly. A point that
    has slid round an edge, or along a curve, has its normal turned by less than a right angle in
    an increment, or its way does not lead through the support.
    """

    def __init__(
        self,
        quadrature: SurfaceQuadrature,
        support: Callable[[Any], Placement] | SampledSupport,
    ) -> None:
        """Bind.

        Args:
            quadrature: The points.
            support: Gap and direction by a place in its frame (UFL), or the support itself.
        """
        self._quadrature, self._support = quadrature, support
        self._place: fem.Function | None = None
        self._evaluate: PointEvaluator | None = None

    def through(self, before: Array, now: Array, turned: Callable[[Array, float], Array]) -> Mask:
        """Which points have passed through on the way from one place to another. Collective.

        Args:
            before: In the frame of the support, (n_points, gdim).
            now: Likewise.
            turned: Turns places by a share of the turn of the support on that way.
        """
        (first, old), (last, new) = self.sample(before), self.sample(now)
        # In the frame of the start, that does not turn.
        end = turned(now, 1.0)
        opposite = np.sum(old * (turned(now + new, 1.0) - end), axis=1) < 0
        if not self._quadrature.surface.mesh.comm.allreduce(int(opposite.any())):
            return np.zeros(len(opposite), dtype=np.bool_)
        shares = np.arange(1, _PLACES + 1) / (_PLACES + 1)
        places = [turned(before + t * (end - before), -t) for t in shares]
        between = np.min([self.sample(place)[0] for place in places], axis=0)
        deeper = np.minimum(first, last) - between
        far = _DEEPER * np.linalg.norm(end - before, axis=1)
        return np.asarray(opposite & (between < 0) & (deeper > far))

    def sample(self, place: Array) -> tuple[Array, Array]:
        """Distances and unit normals from body to support at places. Collective.

        Args:
            place: In the frame of the support, (n_points, gdim).

        Returns:
            (n_points,) (length) and (n_points, gdim).
        """
        if isinstance(self._support, SampledSupport):
            with collective_errors(self._quadrature.surface.mesh.comm):
                found = self._support.sample_checked(place)
            return found.distance, found.normal
        if self._place is None or self._evaluate is None:
            self._place = fem.Function(self._quadrature.space(place.shape[1]), name="place")
            seen = self._support(self._place)
            self._evaluate = PointEvaluator(
                self._quadrature, {"gap": seen.gap, "normal": seen.normal}
            )
        self._place.x.array[: place.size] = place.ravel()
        self._place.x.scatter_forward()
        values = self._evaluate()
        return values["gap"], values["normal"]
