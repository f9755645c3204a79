"""Types of arrays and expressions."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import ufl

__all__ = ["Array", "Expr", "Index", "Indices", "Mask", "Values"]

Array: TypeAlias = npt.NDArray[np.float64]
Mask: TypeAlias = npt.NDArray[np.bool_]
# Indices in DOLFINx and PETSc, and in NumPy.
Indices: TypeAlias = npt.NDArray[np.int32]
Index: TypeAlias = npt.NDArray[np.integer[Any]]
Expr: TypeAlias = ufl.core.expr.Expr
# Values of a law's parameters by name.
Values: TypeAlias = Mapping[str, Expr]
