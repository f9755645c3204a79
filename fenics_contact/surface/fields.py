"""Fields at the quadrature points of Γc, such as the history variables of a contact."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["PointFields"]


class PointFields:
    """Named fields in one quadrature function, initially zero.

    They are changed by `assign` and `set_rows` only. The constructor is collective.

    Args:
        fields: Number of components by name; 0 for a scalar.

    Attributes:
        function: All fields as a coefficient of forms, defined on the submesh of Γc.
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
        """Return whether a field exists."""
        return name in self._slices

    @property
    def names(self) -> list[str]:
        """Names of the fields."""
        return list(self._slices)

    def ufl(self, name: str) -> ufl.core.expr.Expr:
        """Return the field as a UFL scalar or vector."""
        columns = self._slices[name]
        if isinstance(columns, int):
            return self.function[columns]
        return ufl.as_vector([self.function[i] for i in range(columns.start, columns.stop)])

    def values(self, name: str) -> Array:
        """Return a copy of the values at the owned points, (n_points,) or (n_points, d)."""
        rows = self.function.x.array.reshape(-1, self._size)
        return rows[: self._n_owned, self._slices[name]].copy()

    def rows(self) -> Array:
        """Return a copy of all fields at the owned points, (n_points, n_components)."""
        return self.function.x.array.reshape(-1, self._size)[: self._n_owned].copy()

    def set_rows(self, rows: Array) -> None:
        """Set all fields from an array as returned by `rows`. Collective.

        Raises:
            ValueError: The shape is wrong.
        """
        array = self.function.x.array.reshape(-1, self._size)
        if rows.shape != (self._n_owned, self._size):
            raise ValueError(
                f"history has shape {rows.shape}; this contact's is {(self._n_owned, self._size)}"
            )
        array[: self._n_owned] = rows
        self.function.x.scatter_forward()

    def packed(self, values: Mapping[str, Array]) -> Array:
        """Return named fields as one array ordered as `rows`, (n_points, n_components).

        Raises:
            KeyError: A field is missing.
            ValueError: A shape is wrong.
        """
        rows = np.empty((self._n_owned, self._size))
        for name, columns in self._slices.items():
            rows[:, columns] = values[name]
        return rows

    def assign(self, values: Mapping[str, Array]) -> None:
        """Set all fields by name at the owned points. Collective.

        Raises:
            KeyError: A field is missing; no field is changed.
            ValueError: A shape is wrong; no field is changed.
        """
        self.set_rows(self.packed(values))
