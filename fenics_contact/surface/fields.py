"""The committed state of a contact: fields at the quadrature points of Γc."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["PointFields"]


class PointFields:
    """Named fields in one quadrature function, changed by `assign` and `set_rows` alone.

    All are zero at first. The constructor is collective.

    Args:
        fields: Number of components by name; 0 stands for a scalar.

    Attributes:
        function: The function that holds all fields, for use in forms (a coefficient on the
            submesh of Γc).
    """

    def __init__(self, quadrature: SurfaceQuadrature, fields: Mapping[str, int]) -> None:
        self._slices: dict[str, int | slice] = {}
        size = 0
        for name, components in fields.items():
            self._slices[name] = slice(size, size + components) if components else size
            size += max(components, 1)
        self.function = fem.Function(quadrature.space(size), name="history")
        self._n_owned = quadrature.n_points
        self._size = size

    def __contains__(self, name: str) -> bool:
        """Whether there is such a field."""
        return name in self._slices

    @property
    def names(self) -> list[str]:
        """Names of the fields."""
        return list(self._slices)

    def ufl(self, name: str) -> ufl.core.expr.Expr:
        """The field as a UFL scalar or vector, for use in forms."""
        place = self._slices[name]
        if isinstance(place, int):
            return self.function[place]
        return ufl.as_vector([self.function[i] for i in range(place.start, place.stop)])

    def values(self, name: str) -> Array:
        """Values at the owned points, (n_points,) or (n_points, d); a copy."""
        rows = self.function.x.array.reshape(-1, self._size)
        return rows[: self._n_owned, self._slices[name]].copy()

    def rows(self) -> Array:
        """All fields at the owned points, (n_points, n_components); a copy."""
        return self.function.x.array.reshape(-1, self._size)[: self._n_owned].copy()

    def set_rows(self, rows: Array) -> None:
        """Put back what `rows` gave. Collective.

        Raises:
            ValueError: The shape is another.
        """
        array = self.function.x.array.reshape(-1, self._size)
        if rows.shape != (self._n_owned, self._size):
            raise ValueError(
                f"history has shape {rows.shape}; this contact's is {(self._n_owned, self._size)}"
            )
        array[: self._n_owned] = rows
        self.function.x.scatter_forward()

    def packed(self, values: Mapping[str, Array]) -> Array:
        """Return fields given by name as `rows` has them, (n_points, n_components).

        Raises:
            KeyError: A field is missing.
            ValueError: A shape is wrong.
        """
        rows = np.empty((self._n_owned, self._size))
        for name, place in self._slices.items():
            rows[:, place] = values[name]
        return rows

    def assign(self, values: Mapping[str, Array]) -> None:
        """Replace every field by its values at the owned points. Collective.

        Raises:
            KeyError: A field is missing; nothing has changed then.
            ValueError: A shape is wrong; nothing has changed then.
        """
        self.set_rows(self.packed(values))
