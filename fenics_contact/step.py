"""The result of one increment and its summary."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_contact.checks.energy import Energy
from fenics_contact.checks.verdict import Verdict
from fenics_contact.contact.values import Resultants
from fenics_contact.markup import html_table
from fenics_contact.methods.attempt import Attempt
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["Step"]


@dataclass(frozen=True)
class Step:
    """The result of one increment.

    Attributes:
        increment: Number of the increment, from 1.
        reason: SNES reason of the last solve (positive: converged).
        iterations: Number of SNES iterations of all attempts.
        augmentations: Number of solutions with different multipliers, 1 with a penalty.
        method: Method of `ContactProblem` that found the solution.
        factorisations: Number of sparse factorisations, without dense ones of condensed problems.
        verdict: The verification of the solution.
        contacts: `Resultants` of every contact, by name.
        energy: Works and energies of the increment.
        attempts: All attempts in their order; the last one found the solution.
        wall_seconds: Time of the solve on this rank (s).
        load: Load parameter, if the step was made by `increments`.
        increment_error: Accumulated error of the increment size by quantity of `ErrorBudget`, with
            ``increments(estimate=True)``.
        complete: Whether the interior displacement is up to date; see `ContactProblem.complete`.
    """

    increment: int
    reason: int
    iterations: int
    augmentations: int
    method: str
    factorisations: int
    verdict: Verdict
    contacts: dict[str, Resultants]
    energy: Energy
    attempts: tuple[Attempt, ...]
    wall_seconds: float
    load: float | None = None
    increment_error: dict[str, float] | None = None
    complete: bool = True

    def summary(self) -> str:
        """Return a summary of the increment in one line.

        For every contact, "force" is ∫ -r_n, "friction ∫|τ|" the integral of the magnitude, and
        "resultant" the force vector on the body. A contact whose forces do not exceed the tolerance
        of the residual (`ForceBalance.is_loaded`) has "no contact force". Small-displacement errors
        are stated from 1 % of force or pressure on, and at the end whether values are per unit
        thickness.
        """
        parts = [f"increment {self.increment}"]
        if self.load is not None:
            parts.append(f"load {self.load:.6g}")
        parts.append(self._describe_solve())
        parts.append(self._describe_residual())
        for name, r in self.contacts.items():
            if not self._is_loaded(name):
                parts.append(f"{name}: no contact force")
                continue
            normal, friction, resultant = self._format_forces(name)
            parts.append(
                f"{name}: force {normal}, friction ∫|τ| {friction}, resultant {resultant}, "
                f"area {r.area:.4g}, {r.stick} stick {r.slip} slip {r.open} open"
            )
        per_thickness = ["forces and areas per unit thickness"] * self._per_thickness
        return "; ".join([*parts, *self._small_displacement_remarks(), *per_thickness])

    def _small_displacement_remarks(self) -> list[str]:
        """Return the notable small-displacement errors of the contacts in words."""
        return [
            f"{name}: displacements are assumed small; otherwise {error.describe()}"
            for name, error in self.verdict.small_displacement_error.items()
            if error.is_notable
        ]

    @property
    def _per_thickness(self) -> bool:
        return any(r.per_thickness for r in self.contacts.values())

    def _describe_residual(self) -> str:
        if not self.verdict.is_loaded:
            return "no forces"
        return f"residual {self.verdict.relative_residual:.1e} of the forces"

    def _is_loaded(self, contact: str) -> bool:
        return self.verdict.equations[contact].is_loaded

    def _format_forces(self, contact: str) -> tuple[str, str, str]:
        """Return normal force, friction and resultant of a contact; 0 if it is not loaded."""
        r = self.contacts[contact]
        loaded = float(self._is_loaded(contact))
        normal, friction = (f"{loaded * f:.6g}" for f in (r.normal_force, r.tangential_force))
        return normal, friction, _format_vector(loaded * r.force)

    def _describe_solve(self) -> str:
        """Return the method and the number of iterations in words."""
        if not self.iterations:
            return f"{self.method}: solved by the predictor"
        return f"{self.method}: {self.iterations} iteration{'s' if self.iterations > 1 else ''}"

    def _repr_html_(self) -> str:
        """Return the summary as a table for notebooks."""
        title = f"Increment {self.increment}"
        if self.load is not None:
            title += f", load {self.load:.6g}"
        header = ("contact", "∫ pressure", "friction ∫|τ|", "resultant on the body", "area")
        rows = [
            (
                name,
                *self._format_forces(name),
                f"{r.area:.4g}",
                *(str(n) if self._is_loaded(name) else "–" for n in (r.stick, r.slip, r.open)),
            )
            for name, r in self.contacts.items()
        ]
        solution = f"{self._describe_solve()}; {self._describe_residual()}"
        remarks = [solution, *self._small_displacement_remarks()]
        remarks += ["Forces and areas are per unit thickness."] * self._per_thickness
        return html_table(title, (*header, "stick", "slip", "open"), rows, remarks)


def _format_vector(vector: Array) -> str:
    """Format a vector, with components that are negligible relative to its length as 0."""
    size = np.linalg.norm(vector)
    return "(" + ", ".join(f"{v if abs(v) > NEGLIGIBLE * size else 0:.6g}" for v in vector) + ")"
