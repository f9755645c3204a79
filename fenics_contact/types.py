"""Types of arrays that all modules share."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import ufl

__all__ = ["Array", "Expr", "Index", "Indices", "Mask", "Values"]

# Numbers at points, at unknowns, of coordinates.
Array: TypeAlias = npt.NDArray[np.float64]
# Which of them.
Mask: TypeAlias = npt.NDArray[np.bool_]
# Their numbers, as DOLFINx and PETSc have them, and as NumPy has.
Indices: TypeAlias = npt.NDArray[np.int32]
Index: TypeAlias = npt.NDArray[np.integer[Any]]
Expr: TypeAlias = ufl.core.expr.Expr
# Values of a law's parameters by name.
Values: TypeAlias = Mapping[str, Expr]
