"""Error estimates of a solution by source: enforcement, mesh, increments, kinematics, solver.

Each error is estimated separately, for contact force, peak pressure and displacement. Those of
enforcement, kinematics and solver follow from linear solves with the present tangent, that of the
discretisation from stress recovery, and that of the increments from their halves (`increments`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import dolfinx.fem.petsc
import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.checks.kinematics import Deviation, spring_stiffness, traction_change
from fenics_contact.compiling import compile_form
from fenics_contact.contact.choices import is_regularised
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.markup import html_table
from fenics_contact.parallel import global_max, global_sum, longest
from fenics_contact.problem import ContactProblem
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.mass import assembled, mass_solver
from fenics_contact.surface.surface import PointEvaluator
from fenics_contact.types import Array

__all__ = ["ErrorBudget", "estimate_errors", "quantities"]


DISPLACEMENT = "displacement"
# What to change where a part dominates.
_REMEDIES = {
    "enforcement": 'Contact(enforcement="augmented"), with it a smaller tolerance,',
    "discretisation": "a finer mesh at the contact, or a higher degree",
    "increments": "more increments",
    "kinematics": 'Contact(kinematics="finite"), or a motion of the obstacle instead of the body,',
    "solver": "a smaller snes_rtol",
}


# Facets in a row under pressure from which on discretisation is estimated reliably.
_FEW = 5


@dataclass(frozen=True)
class ErrorBudget:
    """Estimated errors of a solution by source, the same on every rank.

    Attributes:
        values: The quantities: for every contact "normal force" (force), "friction force" (force)
            and "peak pressure" (stress), preceded by the contact's name if there are several; and
            "displacement", the mean displacement in the direction of the loads, or without loads
            the largest one (length).
        parts: Absolute errors by source and quantity. The sources are "enforcement",
            "discretisation", "increments", "kinematics" (the small-displacement assumption) and
            "solver". The sign is that of value minus exact value, where it is known. A source that
            could not be estimated has no entry.
        wanted: The relative error of the contacts' `Accuracy`; None without one.
        h: Mean size of the facets under pressure (length).
        across: Approximate number of facets under pressure in a row: their number in two
            dimensions, its square root in three. Below five the estimate of the discretisation
            error is unreliable.
        degree: Degree of the displacement element.
        energy: Relative discretisation error in the energy norm.
        cells: Squares of the discretisation error of the cells that this rank owns (force times
            length).
    """

    values: dict[str, float]
    parts: dict[str, dict[str, float]]
    wanted: float | None = None
    h: float = 0.0
    across: float = 0.0
    degree: int = 1
    energy: float = 0.0
    cells: Array | None = field(default=None, repr=False, compare=False)

    def numbers(self) -> dict[str, Any]:
        """Return all attributes except ``cells``, for files; invert it by ``ErrorBudget(**…)``."""
        names = ("values", "parts", "wanted", "h", "across", "degree", "energy")
        return {name: getattr(self, name) for name in names}

    @property
    def h_wanted(self) -> float:
        """Size of facets that the accuracy wanted requires, at most the present one (length).

        Since the pressure has a square-root singularity at the end of contact, forces converge at
        most like h³ and pressures like h^(3/2), whatever the degree.
        """
        if self.wanted is None:
            return self.h
        needed = self.h
        for name, error in self.relative("discretisation").items():
            rate = min(self.degree, 1.5) * (1 if name.endswith("pressure") else 2)
            if error > self.wanted:
                needed = min(needed, self.h * (self.wanted / error) ** (1 / rate))
        return needed

    def relative(self, part: str) -> dict[str, float]:
        """Return the relative errors of a source without sign, by quantity."""
        return {
            name: abs(error) / (abs(self.values[name]) or 1.0)
            for name, error in self.parts[part].items()
        }

    @property
    def total(self) -> dict[str, float]:
        """Relative errors of all sources together, by quantity: the root of the sum of squares.

        The sources are independent, and their signs are not all known.
        """
        squares = dict.fromkeys(self.values, 0.0)
        for part in self.parts:
            for name, error in self.relative(part).items():
                squares[name] += error**2
        return {name: float(np.sqrt(square)) for name, square in squares.items()}

    @property
    def dominant(self) -> str:
        """The source with the largest relative error in any quantity."""
        return max(self.parts, key=lambda part: max(self.relative(part).values(), default=0.0))

    def __str__(self) -> str:
        """Return a table of the errors in per cent, and what to change."""
        width = max(14, *(len(name) + 2 for name in self.values))
        lines = ["error in %".ljust(16) + "".join(f"{name:>{width}}" for name in self.values)]
        for part, *cells in self._rows():
            lines.append(f"{part:<16}" + "".join(f"{cell:>{width}}" for cell in cells))
        return "\n".join([*lines, *self._remarks()])

    def _repr_html_(self) -> str:
        """Return a table of the errors in per cent for notebooks, with the total."""
        total = self.total
        together = ("together", *(f"{100 * total[name]:.2g}" for name in self.values))
        header = ("error in %", *self.values)
        return html_table("Error budget", header, [*self._rows(), together], self._remarks())

    def _rows(self) -> list[tuple[str, ...]]:
        """Every part with its errors in per cent."""
        rows = []
        for part in _REMEDIES:
            found = self.relative(part) if part in self.parts else {}
            cells = (
                f"{100 * found[n]:.2g}" if n in found else "not estimated" for n in self.values
            )
            rows.append((part, *cells))
        return rows

    def _remarks(self) -> list[str]:
        """What to change, and how far the table can be trusted."""
        lines = [f"{self.dominant} dominates: {_REMEDIES[self.dominant]} would help most"]
        if 0 < self.across < _FEW:
            lines.append(
                f"only about {self.across:.0f} facets in a row are under pressure: the estimate of "
                f"discretisation is unreliable with fewer than {_FEW}"
            )
        if self.wanted is not None:
            size = f"facets of {self.h_wanted:.2g} at the contact, now {self.h:.2g}"
            enough = "the mesh is fine enough" if self.h_wanted >= self.h else f"use {size}"
            lines.append(f"for the accuracy of {self.wanted:.2g} {enough}")
        return lines


def quantities(problem: ContactProblem) -> dict[str, float]:
    """The quantities of an `ErrorBudget` at the problem's present state. Collective."""
    found: dict[str, float] = {}
    for contact in problem.contacts:
        r = contact.resultants()
        found |= _named(problem, contact, r.normal_force, r.tangential_force, r.max_pressure)
    return found | {DISPLACEMENT: _displacement(problem, problem.present_state())}


def estimate_errors(
    problem: ContactProblem,
    stress: Any,
    *,
    strain: Any = None,
    increment_error: Mapping[str, float] | None = None,
) -> ErrorBudget:
    """Estimate the errors of the last solution by source, before or after its commit. Collective.

    Errors of contact forces, peak pressures and displacement are estimated: by linearisation for
    enforcement, small displacements and solver, and by stress recovery for the discretisation. The
    estimates are not bounds. The cost is a factorisation of the tangent (a dense one of a condensed
    problem) and a projection of stress and strain.

    Args:
        problem: A problem that has been solved; its state does not change.
        stress: Stress σ(u) of the bulk (UFL), shape (d, d), or (3, 3) as of
            ``elasticity.LinearElastic`` and ``elasticity.NeoHookean``.
        strain: Strain ε(u) of the same shape. By default sym(grad u); with a stress (3, 3) in the
            plane, the strain out of the plane is u_r/r if the stress depends on u itself, as that
            of an axisymmetric body, and otherwise zero.
        increment_error: ``Step.increment_error``, the errors due to the increment size; without
            it they are not part of the result.

    Returns:
        The `ErrorBudget`. Printed, it is a table in per cent that names the dominant source.

    Raises:
        ValueError: The shapes of stress and strain differ; or a body or free obstacle is not
            constrained at this state.
    """
    problem.complete()
    displacement = problem.displacement
    stress = ufl.as_ufl(stress)
    strain = _conjugate_strain(displacement, stress) if strain is None else ufl.as_ufl(strain)
    if stress.ufl_shape != strain.ufl_shape or len(stress.ufl_shape) != 2:
        raise ValueError(
            f"stress has shape {stress.ufl_shape}, strain {strain.ufl_shape}; both must be (d, d) "
            "or (3, 3)"
        )
    values = quantities(problem)
    parts = _linear_parts(problem, values)
    smooth = _Smoothed(problem, stress, strain)
    parts["discretisation"] = _discretisation(problem, smooth, values)
    if increment_error is not None:
        parts["increments"] = dict(increment_error)
    h, across = _bearing_facets(problem)
    return ErrorBudget(
        values,
        {name: parts[name] for name in _REMEDIES if name in parts},
        wanted=problem.accuracy.error if problem.accuracy else None,
        h=h,
        across=across,
        degree=displacement.degree,
        energy=float(np.sqrt(smooth.share)),
        cells=smooth.squares,
    )


def _conjugate_strain(displacement: Displacement, stress: Any) -> Any:
    """The small strain that the stress does work on, of its shape (UFL)."""
    u = displacement.expression
    strain = ufl.sym(ufl.grad(u))
    if stress.ufl_shape != (3, 3) or strain.ufl_shape == (3, 3):
        return strain
    hoop = u[0] / ufl.SpatialCoordinate(displacement.u.function_space.mesh)[0]
    across = hoop if displacement.is_undifferentiated_in(stress) else 0
    (xx, xy), (_, yy) = ([strain[i, j] for j in range(2)] for i in range(2))
    return ufl.as_tensor([[xx, xy, 0], [xy, yy, 0], [0, 0, across]])


def _bearing_facets(problem: ContactProblem) -> tuple[float, float]:
    """Mean size area^(1/(d-1)) of the facets under pressure, and how many are in a row. Collective.

    Of all contacts together; size (length).
    """
    d = problem.u.function_space.mesh.geometry.dim
    sums = np.zeros(2)
    for contact in problem.contacts:
        rows = contact.quadrature.point_rows
        bears = np.any(contact.pressure[rows] > 0, axis=1)
        sizes = contact.quadrature.facet_sizes[rows[:, 0]]
        sums += [np.sum(bears * sizes), np.count_nonzero(bears)]
    size, count = global_sum(problem.u.function_space.mesh.comm, sums)
    return (float(size / count), float(count ** (1 / (d - 1)))) if count else (0.0, 0.0)


def _named(
    problem: ContactProblem, contact: Contact, normal: float, friction: float, peak: float
) -> dict[str, float]:
    before = f"{contact.name}: " if len(problem.contacts) > 1 else ""
    found = {f"{before}normal force": normal}
    if contact.law.has_tangential:
        found[f"{before}friction force"] = friction
    return found | {f"{before}peak pressure": peak}


def _displacement(problem: ContactProblem, state: Array) -> float:
    """Displacement of the loads along themselves; without loads the largest one."""
    comm, load = problem.u.function_space.mesh.comm, problem.load
    of_nodes = np.linalg.norm(problem.displacement.vectors(load), axis=1)
    others = load.copy()  # forces on free obstacles
    others[: problem.full.unknowns.n_dofs] = 0.0
    size, work = global_sum(comm, [of_nodes.sum() + np.abs(others).sum(), load @ state])
    if size > 0:
        return float(work / size)
    return longest(comm, problem.displacement.vectors(state))


# ---- enforcement and solver ----------------------------------------------------------------------


def _linear_parts(
    problem: ContactProblem, values: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """What the springs and the residual that is left have changed in the quantities."""
    contacts, operators = problem.contacts, problem.full.operators
    springs = [spring_stiffness(contact) for contact in contacts]
    stretches = [_stretch(contact) for contact in contacts]
    found = {}

    def differences(way: Array, shifts: list[Array]) -> dict[str, float]:
        jumps = [shift + o.jump(way) for o, shift in zip(operators, shifts, strict=True)]
        changes = [traction_change(k, jump) for k, jump in zip(springs, jumps, strict=True)]
        return _differences(problem, values, changes, way)

    with problem.linearised(springs) as solve:
        found["solver"] = differences(solve(None), [np.zeros_like(s) for s in stretches])
        # The springs' rest lengths follow what they carry: a round of augmented enforcement.
        # It leaves 1/(1 + k_n h/E) of the error in the shortest waves and far less in the long ones
        # that forces are made of.
        way = solve([traction_change(*both) for both in zip(springs, stretches, strict=True)])
        found["enforcement"] = differences(way, stretches)
    moved = [Deviation.of(contact).linearised(contact) for contact in contacts]
    with problem.linearised([k for k, _ in moved]) as solve:
        way = solve([added for _, added in moved])
        pairs = zip(moved, operators, strict=True)
        changes = [added + traction_change(k, o.jump(way)) for (k, added), o in pairs]
        found["kinematics"] = _differences(problem, values, changes, way)
    return found


def _stretch(contact: Contact) -> Array:
    """Displacement that is in the springs because their stiffness stands for none at all.

    As far as displacements of Γc can answer it; none where the stiffness is physical. Collective.

    Returns:
        Array (n_points, gdim) (length).
    """
    law, values, normal = contact.law, contact.values, contact.values.normal
    stretch = np.zeros_like(normal)
    if not is_regularised(law):
        return stretch
    pressure: Array = np.zeros(len(normal))
    if law.has_normal_stiffness:
        pressure = contact.traces(contact.pressure)
    side = contact.traces(contact.tangential_traction)
    if contact.multipliers is not None:
        pressure = pressure - contact.multipliers.fields.values("pressure")
        if law.has_friction:
            side = side - contact.multipliers.fields.values("traction")
    borne = side - pressure[:, None] * normal
    if law.has_normal_stiffness:
        along = -np.sum(borne * normal, axis=1)
        stretch += (along / contact.normal_stiffness)[:, None] * normal
    if law.has_tangential:
        # K_t has no inverse along the normal, where nothing acts: any stiffness will do.
        along = np.einsum("q,qi,qj->qij", values.parameters["k_t"], normal, normal)
        across = values.tangential(borne)[:, :, None]
        stretch -= np.linalg.solve(contact.tangential_stiffness + along, across)[:, :, 0]
    return stretch


def _differences(
    problem: ContactProblem, values: Mapping[str, float], changes: list[Array], way: Array
) -> dict[str, float]:
    """Present quantities minus those after a change of tractions and displacements."""
    comm = problem.u.function_space.mesh.comm
    after: dict[str, float] = {}
    for contact, change in zip(problem.contacts, changes, strict=True):
        normal, measure = contact.values.normal, contact.measure
        along = np.sum(change * normal, axis=1)
        pressure, side = contact.pressure - along, change - along[:, None] * normal
        friction = np.linalg.norm(contact.tangential_traction + side, axis=1)
        if contact.law.has_friction:
            friction = np.minimum(friction, _friction_bound(contact, pressure))
        sums = global_sum(comm, [measure @ pressure, measure @ friction])
        peak = global_max(comm, pressure)
        after |= _named(problem, contact, float(sums[0]), float(sums[1]), peak)
    after[DISPLACEMENT] = _displacement(problem, problem.present_state() + way)
    return {name: values[name] - after[name] for name in values}


def _friction_bound(contact: Contact, pressure: Array) -> Array:
    """Friction bound at the points under another pressure (stress)."""
    values = contact.values
    bound = values.friction_bound
    changed = bound + values.friction_bound_slope * (pressure - contact.pressure)
    return np.where(contact.status == Status.OPEN, bound, np.maximum(changed, 0.0))


# ---- discretisation ------------------------------------------------------------------------------


class _Smoothed:
    """Stresses and strains beside smooth ones (Zienkiewicz and Zhu). The constructor is collective.

    Attributes:
        stress: Smooth σ* (UFL).
        squares: η² = ∫ (σ* - σ):(ε* - ε) of every owned cell (force times length).
        twice_energy: ∫ σ:ε (force times length).
        share: Sum of the squares over that.
    """

    def __init__(self, problem: ContactProblem, stress: Any, strain: Any) -> None:
        mesh = problem.u.function_space.mesh
        weight = problem.contacts[0].inputs.weight if problem.contacts else 1.0
        degree = problem.displacement.degree
        dx = ufl.dx(mesh, metadata={"quadrature_degree": 2 * degree})
        self.stress, smooth_strain = _smoothed(mesh, [stress, strain], degree, weight, dx)
        gap = ufl.inner(self.stress - stress, smooth_strain - strain)
        q = ufl.TestFunction(fem.functionspace(mesh, ("DG", 0)))
        both = [weight * q * density * dx for density in (gap, ufl.inner(stress, strain))]
        n = mesh.topology.index_map(mesh.topology.dim).size_local
        # Every cell has one value, by its own number.
        self.squares, energies = (
            fem.assemble_vector(compile_form(form)).array[:n].copy() for form in both
        )
        total, self.twice_energy = global_sum(mesh.comm, [self.squares.sum(), energies.sum()])
        self.share = abs(total / self.twice_energy) if self.twice_energy else 0.0


def _discretisation(
    problem: ContactProblem, smooth: _Smoothed, values: Mapping[str, float]
) -> dict[str, float]:
    """The potential energy is off by η²/2.

    Per elastic energy that is the relative error of what a prescribed displacement needs as force,
    or of how far a force goes. Friction is told from its share in the normal force that the smooth
    stress has on Γc, the peak from the pressure smoothed on Γc itself.
    """
    contacts, mesh = problem.contacts, problem.u.function_space.mesh
    state, twice, share = problem.present_state(), smooth.twice_energy, smooth.share
    work = float(global_sum(mesh.comm, problem.load @ state))
    loaded = float(np.clip(work / twice, 0.0, 1.0)) if twice else 0.0
    driven = 1.0 - loaded
    found: dict[str, float] = {}
    for contact in contacts:
        d, normals = mesh.geometry.dim, contact.values.normal
        plane = ufl.as_tensor([[smooth.stress[i, j] for j in range(d)] for i in range(d)])
        outward = ufl.dot(plane, ufl.FacetNormal(mesh))
        traction = PointEvaluator(contact.quadrature, {"traction": outward})()["traction"]
        normal = np.sum(traction * normals, axis=1)
        side = np.linalg.norm(traction - normal[:, None] * normals, axis=1)
        closed = contact.status != Status.OPEN
        measure = contact.measure * closed
        smooth_normal, smooth_friction = global_sum(mesh.comm, [-measure @ normal, measure @ side])
        r = contact.resultants()
        error = share * driven * r.normal_force
        # Smoothing carries traction beyond the end of contact: normal and tangential alike, so that
        # their ratio stays.
        kept = (r.normal_force - error) / smooth_normal if smooth_normal > 0 else 1.0
        friction = r.tangential_force - kept * smooth_friction
        if contact.law.has_friction and not contact.law.has_potential and not r.stick:
            # All of it is the law's share of the pressure.
            friction = error * r.tangential_force / (r.normal_force or 1.0)
        found |= _named(
            problem,
            contact,
            error,
            friction,
            r.max_pressure - _smooth_peak(contact),
        )
    if not np.any(global_sum(mesh.comm, np.abs(problem.load).sum())):
        loaded = 0.0 if _largest_is_prescribed(problem, state) else 1.0
    found[DISPLACEMENT] = -share * loaded * values[DISPLACEMENT]
    return found


def _smooth_peak(contact: Contact) -> float:
    """Largest pressure when its means over the facets are smoothed. Collective.

    Smooth stresses of the bulk would not do: at a boundary they are of less than the pressure's own
    accuracy. Means and linear functions serve any degree and rule, for the pressure ends like a
    square root and is nowhere of more than the order h² that they have.
    """
    quadrature, submesh = contact.quadrature, contact.surface.submesh
    n_cells = submesh.topology.index_map(submesh.topology.dim).size_local
    points = quadrature.space().dofmap.list[:n_cells]
    weights, pressure = quadrature.weights[points], contact.pressure[points]
    space = fem.functionspace(submesh, ("DG", 0))
    mean, bears = fem.Function(space), fem.Function(space)
    cells = space.dofmap.list[:n_cells, 0]
    mean.x.array[cells] = np.sum(weights * pressure, axis=1) / np.sum(weights, axis=1)
    bears.x.array[cells] = np.any(pressure > 0, axis=1)
    for function in (mean, bears):
        function.x.scatter_forward()
    smooth = _projected(submesh, [mean], 1, bears, ufl.dx(submesh))
    at_points = PointEvaluator(quadrature, {"pressure": smooth[0]})()["pressure"]
    return global_max(submesh.comm, at_points)


def _largest_is_prescribed(problem: ContactProblem, state: Array) -> bool:
    n = problem.full.unknowns.n_dofs
    held, size = problem.full.constrained[:n], np.abs(state[:n])
    comm = problem.u.function_space.mesh.comm
    return global_max(comm, size[held]) >= global_max(comm, size[~held])


def _smoothed(
    mesh: dolfinx.mesh.Mesh, tensors: list[Any], degree: int, weight: Any, dx: ufl.Measure
) -> list[Any]:
    """L2 projections of symmetric tensors onto continuous functions of a degree. Collective."""
    pairs = [(t, i, j) for t in tensors for i in range(t.ufl_shape[0]) for j in range(i + 1)]
    found = _projected(mesh, [t[i, j] for t, i, j in pairs], degree, weight, dx)
    place = {(id(t), i, j): c for c, (t, i, j) in enumerate(pairs)}
    return [
        ufl.as_tensor(
            [
                [found[place[id(t), max(i, j), min(i, j)]] for j in range(t.ufl_shape[0])]
                for i in range(t.ufl_shape[0])
            ]
        )
        for t in tensors
    ]


def _projected(
    mesh: dolfinx.mesh.Mesh, scalars: list[Any], degree: int, weight: Any, dx: ufl.Measure
) -> fem.Function:
    """L2 projections onto continuous functions of a degree, as one vector. Collective.

    They vanish at nodes around which the weight is zero.
    """
    space = fem.functionspace(mesh, ("Lagrange", degree))
    p, q = ufl.TrialFunction(space), ufl.TestFunction(space)
    mass = fem.petsc.assemble_matrix(compile_form(weight * p * q * dx))
    mass.assemble()
    all_at_once = fem.functionspace(mesh, ("Lagrange", degree, (len(scalars),)))
    right = fem.Function(all_at_once)
    form = weight * ufl.dot(ufl.as_vector(scalars), ufl.TestFunction(all_at_once)) * dx
    assembled(compile_form(form), right.x)
    ksp = mass_solver(mass, rtol=1e-8)
    known, found = fem.Function(space), fem.Function(all_at_once)
    for c in range(len(scalars)):
        known.x.array[:] = right.x.array[c :: len(scalars)]
        solution = fem.Function(space)
        ksp.solve(known.x.petsc_vec, solution.x.petsc_vec)
        solution.x.scatter_forward()
        found.x.array[c :: len(scalars)] = solution.x.array
    ksp.destroy()
    mass.destroy()
    return found
