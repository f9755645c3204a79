"""User data of a contact, sampled at the quadrature points.

A law is evaluated with values at the points, so that the compiled law serves every obstacle, gap
and body. The values follow the constants and functions in the expressions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import ufl
from dolfinx import fem

from fenics_contact.parallel import raise_collectively
from fenics_contact.surface.dependence import Dependence
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["PointData"]


class PointData:
    """Named expressions at the points of Γc, and some of them as functions for the laws.

    The constructor is collective, and compiles them.

    Args:
        expressions: Scalars and vectors by name.
        geometry: Names of the expressions that laws use.

    Attributes:
        values: All values, (n_points,) or (n_points, d), as sampled by the last `update`.

    Raises:
        ValueError: An expression cannot be compiled; raised on all ranks.
    """

    def __init__(
        self,
        name: str,
        quadrature: SurfaceQuadrature,
        expressions: Mapping[str, ufl.core.expr.Expr],
        geometry: Iterable[str],
    ) -> None:
        self._comm = quadrature.surface.mesh.comm
        try:
            self._evaluate = PointEvaluator(quadrature, expressions)
        except Exception as error:
            raise_collectively(self._comm, error)
            failure = _find_uncompilable(quadrature, expressions)
            if failure is None:
                raise
            raise ValueError(f"{name}: {failure}") from error
        form = self._evaluate.form
        self._dependence = Dependence(form.constants(), form.coefficients())
        shapes = {name: ufl.as_ufl(expressions[name]).ufl_shape for name in geometry}
        sizes = {name: shape[0] if shape else 0 for name, shape in shapes.items()}
        self._fields = PointFields(quadrature, sizes)
        self.values: Mapping[str, Array] = {}

    def ufl(self, name: str) -> ufl.core.expr.Expr:
        """Return an expression of the laws as a function at the points (UFL)."""
        return self._fields.ufl(name)

    def depends_on(self, constant: fem.Constant) -> bool:
        """Whether an expression depends on a constant."""
        return self._dependence.has(constant)

    def update(self) -> None:
        """Sample again if a constant or a function has changed. Collective."""
        changed = self._dependence.changed
        if self._comm.size > 1:
            changed = self._comm.allreduce(int(changed)) > 0
        if changed:
            self._dependence.forget()  # in case of an error below
            self.values = self._evaluate()
            self._fields.assign(self.values)
            self._dependence.note()


def _find_uncompilable(
    quadrature: SurfaceQuadrature, expressions: Mapping[str, ufl.core.expr.Expr]
) -> str | None:
    """Return the first expression that does not compile, and why, or None. Collective."""
    comm = quadrature.surface.mesh.comm
    for name, expression in {"": ufl.as_ufl(1.0), **expressions}.items():
        try:
            PointEvaluator(quadrature, {name: expression})
        except Exception as error:
            raise_collectively(comm, error)
            if not name:
                return None
            what = {"initial_gap": "gap"}.get(name, name.removeprefix("parameter "))
            reason = comm.bcast(str(error))
            return (
                f"{what} cannot be compiled for the points of Γc ({reason}); give a number, a "
                "fem.Constant, or a fem.Function that has its values"
            )
    return None
