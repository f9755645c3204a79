"""Error estimates of a solution by source: enforcement, mesh, increments, kinematics, solver.

The errors of enforcement, kinematics and solver follow from linear solves with the present tangent,
the discretisation error from stress recovery, and that of the increments from halved ones.
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
from fenics_contact.parallel import global_max, global_sum, max_norm
from fenics_contact.problem import ContactProblem
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.mass import assemble_values, create_mass_solver
from fenics_contact.surface.surface import PointEvaluator
from fenics_contact.types import Array
from fenics_contact.wording import percent

__all__ = ["ErrorBudget", "estimate_errors", "quantities"]


DISPLACEMENT = "displacement"
# What to change if a source dominates.
_REMEDIES = {
    "enforcement": 'Contact(enforcement="augmented"), with it a smaller tolerance,',
    "discretisation": "a finer mesh at the contact, or a higher degree",
    "increments": "more increments",
    "kinematics": 'Contact(kinematics="finite"), or a motion of the obstacle instead of the body,',
    "solver": "a smaller snes_rtol",
}


# Facets under pressure in a row, below which the estimate of the discretisation is unreliable.
_MIN_RELIABLE_FACETS = 5


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
        across: Approximate number of facets under pressure in a row. Below five the estimate of the
            discretisation error is unreliable.
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
        """Return all attributes except ``cells``, as arguments of ``ErrorBudget``."""
        names = ("values", "parts", "wanted", "h", "across", "degree", "energy")
        return {name: getattr(self, name) for name in names}

    @property
    def h_wanted(self) -> float:
        """Size of facets that the accuracy wanted requires, at most the present one (length).

        Due to the square-root singularity at the end of contact, forces converge at most like h³
        and pressures like h^(3/2).
        """
        if self.wanted is None:
            return self.h
        size = self.h
        for name, error in self.relative("discretisation").items():
            rate = min(self.degree, 1.5) * (1 if name.endswith("pressure") else 2)
            if error > self.wanted:
                size = min(size, self.h * (self.wanted / error) ** (1 / rate))
        return size

    def relative(self, part: str) -> dict[str, float]:
        """Return the relative errors of a source without sign, by quantity."""
        return {
            name: abs(error) / (abs(self.values[name]) or 1.0)
            for name, error in self.parts[part].items()
        }

    @property
    def total(self) -> dict[str, float]:
        """Relative errors of all sources together, by quantity: the root of the sum of squares."""
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
        """Return a table of the relative errors, and what to change."""
        width = max(14, *(len(name) + 2 for name in self.values))
        lines = ["relative error".ljust(16) + "".join(f"{name:>{width}}" for name in self.values)]
        for part, *cells in self._rows():
            lines.append(f"{part:<16}" + "".join(f"{cell:>{width}}" for cell in cells))
        return "\n".join([*lines, *self._remarks()])

    def _repr_html_(self) -> str:
        """Return a table of the relative errors for notebooks, with the total."""
        total = self.total
        total_row = ("together", *(percent(total[name]) for name in self.values))
        header = ("relative error", *self.values)
        return html_table("Error budget", header, [*self._rows(), total_row], self._remarks())

    def _rows(self) -> list[tuple[str, ...]]:
        """Return every source with its relative errors."""
        rows = []
        for part in _REMEDIES:
            errors = self.relative(part) if part in self.parts else {}
            cells = (percent(errors[n]) if n in errors else "not estimated" for n in self.values)
            rows.append((part, *cells))
        return rows

    def _remarks(self) -> list[str]:
        """Return advice, and the reliability of the estimate."""
        lines = [f"{self.dominant} dominates: {_REMEDIES[self.dominant]} would help most"]
        if 0 < self.across < _MIN_RELIABLE_FACETS:
            lines.append(
                f"only about {self.across:.0f} facets in a row are under pressure: the estimate of "
                f"discretisation is unreliable with fewer than {_MIN_RELIABLE_FACETS}"
            )
        if self.wanted is not None:
            size = f"facets of {self.h_wanted:.2g} at the contact, now {self.h:.2g}"
            enough = "the mesh is fine enough" if self.h_wanted >= self.h else f"use {size}"
            lines.append(f"for the accuracy of {self.wanted:.2g} {enough}")
        return lines


def quantities(problem: ContactProblem) -> dict[str, float]:
    """Return the quantities of an `ErrorBudget` at the problem's present state. Collective."""
    values: dict[str, float] = {}
    for contact in problem.contacts:
        r = contact.resultants()
        values |= _name_values(problem, contact, r.normal_force, r.tangential_force, r.max_pressure)
    return values | {DISPLACEMENT: _displacement(problem, problem.present_state())}


def estimate_errors(
    problem: ContactProblem,
    stress: Any,
    *,
    strain: Any = None,
    increment_error: Mapping[str, float] | None = None,
) -> ErrorBudget:
    """Estimate the errors of the last solution by source, before or after its commit. Collective.

    The estimates, by linearisation and stress recovery, are not bounds. They cost a factorisation
    of the tangent (a dense one of a condensed problem) and a projection of stress and strain.

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
    parts = _linearised_errors(problem, values)
    recovery = _StressRecovery(problem, stress, strain)
    parts["discretisation"] = _discretisation_errors(problem, recovery, values)
    if increment_error is not None:
        parts["increments"] = dict(increment_error)
    h, across = _measure_loaded_facets(problem)
    return ErrorBudget(
        values,
        {name: parts[name] for name in _REMEDIES if name in parts},
        wanted=problem.accuracy.error if problem.accuracy else None,
        h=h,
        across=across,
        degree=displacement.degree,
        energy=float(np.sqrt(recovery.ratio)),
        cells=recovery.squares,
    )


def _conjugate_strain(displacement: Displacement, stress: Any) -> Any:
    """Return the small strain conjugate to the stress, in its shape (UFL)."""
    u = displacement.expression
    strain = ufl.sym(ufl.grad(u))
    if stress.ufl_shape != (3, 3) or strain.ufl_shape == (3, 3):
        return strain
    hoop = u[0] / ufl.SpatialCoordinate(displacement.u.function_space.mesh)[0]
    out_of_plane = hoop if displacement.is_undifferentiated_in(stress) else 0
    (xx, xy), (_, yy) = ([strain[i, j] for j in range(2)] for i in range(2))
    return ufl.as_tensor([[xx, xy, 0], [xy, yy, 0], [0, 0, out_of_plane]])


def _measure_loaded_facets(problem: ContactProblem) -> tuple[float, float]:
    """Return mean size (length) and number in a row of the facets under pressure. Collective."""
    d = problem.u.function_space.mesh.geometry.dim
    sums = np.zeros(2)
    for contact in problem.contacts:
        rows = contact.quadrature.point_rows
        loaded = np.any(contact.pressure[rows] > 0, axis=1)
        sizes = contact.quadrature.facet_sizes[rows[:, 0]]
        sums += [np.sum(loaded * sizes), np.count_nonzero(loaded)]
    size, count = global_sum(problem.u.function_space.mesh.comm, sums)
    return (float(size / count), float(count ** (1 / (d - 1)))) if count else (0.0, 0.0)


def _name_values(
    problem: ContactProblem, contact: Contact, normal: float, friction: float, peak: float
) -> dict[str, float]:
    prefix = f"{contact.name}: " if len(problem.contacts) > 1 else ""
    values = {f"{prefix}normal force": normal}
    if contact.law.has_tangential:
        values[f"{prefix}friction force"] = friction
    return values | {f"{prefix}peak pressure": peak}


def _displacement(problem: ContactProblem, state: Array) -> float:
    """Return the mean displacement along the loads; without loads the largest one."""
    comm, load = problem.u.function_space.mesh.comm, problem.present.load
    nodal = np.linalg.norm(problem.displacement.vectors(load), axis=1)
    on_obstacles = load.copy()
    on_obstacles[: problem.full.unknowns.n_dofs] = 0.0
    size, work = global_sum(comm, [nodal.sum() + np.abs(on_obstacles).sum(), load @ state])
    if size > 0:
        return float(work / size)
    return max_norm(comm, problem.displacement.vectors(state))


# ---- enforcement and solver ----------------------------------------------------------------------


def _linearised_errors(
    problem: ContactProblem, values: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """Return the errors of enforcement, kinematics and solver in the quantities."""
    contacts, operators = problem.contacts, problem.full.operators
    problem.complete()
    load = problem.present.load
    springs = [spring_stiffness(contact) for contact in contacts]
    penalty_jumps = [_penalty_jump(contact) for contact in contacts]
    errors = {}

    def differences(change: Array, shifts: list[Array]) -> dict[str, float]:
        jumps = [shift + o.jump(change) for o, shift in zip(operators, shifts, strict=True)]
        tractions = [traction_change(k, jump) for k, jump in zip(springs, jumps, strict=True)]
        return _differences(problem, values, tractions, change)

    with problem.solver.linearised(springs, load) as solve:
        errors["solver"] = differences(solve(None), [np.zeros_like(s) for s in penalty_jumps])
        # One augmentation leaves 1/(1 + k_n h/E) of the error at the shortest wavelengths, and far
        # less at the long ones that determine forces.
        added = [traction_change(k, j) for k, j in zip(springs, penalty_jumps, strict=True)]
        change = solve(added)
        errors["enforcement"] = differences(change, penalty_jumps)
    deformed = [Deviation.of(contact).linearised(contact) for contact in contacts]
    with problem.solver.linearised([k for k, _ in deformed], load) as solve:
        change = solve([added for _, added in deformed])
        pairs = zip(deformed, operators, strict=True)
        tractions = [added + traction_change(k, o.jump(change)) for (k, added), o in pairs]
        errors["kinematics"] = _differences(problem, values, tractions, change)
    return errors


def _penalty_jump(contact: Contact) -> Array:
    """Return the jump due to the penalty, projected onto Γc, (n_points, gdim) (length). Collective.

    It is zero if the stiffness is physical.
    """
    law, values, normal = contact.law, contact.values, contact.values.normal
    jump = np.zeros_like(normal)
    if not is_regularised(law):
        return jump
    pressure: Array = np.zeros(len(normal))
    if law.has_normal_stiffness:
        pressure = contact.traces(contact.pressure)
    tangential = contact.traces(contact.tangential_traction)
    if contact.multipliers is not None:
        pressure = pressure - contact.multipliers.fields.values("pressure")
        if law.has_friction:
            tangential = tangential - contact.multipliers.fields.values("traction")
    traction = tangential - pressure[:, None] * normal
    if law.has_normal_stiffness:
        along = -np.sum(traction * normal, axis=1)
        jump += (along / contact.values.normal_stiffness)[:, None] * normal
    if law.has_tangential:
        # K_t is made regular by any stiffness along the normal, where the traction is zero.
        along = np.einsum("q,qi,qj->qij", values.parameters["k_t"], normal, normal)
        rhs = values.tangential(traction)[:, :, None]
        jump -= np.linalg.solve(contact.values.tangential_stiffness + along, rhs)[:, :, 0]
    return jump


def _differences(
    problem: ContactProblem, values: Mapping[str, float], tractions: list[Array], unknowns: Array
) -> dict[str, float]:
    """Return the present quantities minus those after changes of tractions and unknowns."""
    comm = problem.u.function_space.mesh.comm
    after: dict[str, float] = {}
    for contact, change in zip(problem.contacts, tractions, strict=True):
        normal, measure = contact.values.normal, contact.measure
        along = np.sum(change * normal, axis=1)
        pressure, tangential = contact.pressure - along, change - along[:, None] * normal
        friction = np.linalg.norm(contact.tangential_traction + tangential, axis=1)
        if contact.law.has_friction:
            friction = np.minimum(friction, _friction_bound(contact, pressure))
        sums = global_sum(comm, [measure @ pressure, measure @ friction])
        peak = global_max(comm, pressure)
        after |= _name_values(problem, contact, float(sums[0]), float(sums[1]), peak)
    after[DISPLACEMENT] = _displacement(problem, problem.present_state() + unknowns)
    return {name: values[name] - after[name] for name in values}


def _friction_bound(contact: Contact, pressure: Array) -> Array:
    """Return the friction bound at the points under another pressure (stress)."""
    values = contact.values
    bound = values.friction_bound
    changed = bound + values.friction_bound_slope * (pressure - contact.pressure)
    return np.where(contact.status == Status.OPEN, bound, np.maximum(changed, 0.0))


# ---- discretisation ------------------------------------------------------------------------------


class _StressRecovery:
    """Stress recovery by Zienkiewicz and Zhu. The constructor is collective.

    Attributes:
        stress: Recovered stress σ* (UFL).
        squares: η² = ∫ (σ* - σ):(ε* - ε) of every owned cell (force times length).
        twice_energy: ∫ σ:ε (force times length).
        ratio: Sum of η² divided by ∫ σ:ε.
    """

    def __init__(self, problem: ContactProblem, stress: Any, strain: Any) -> None:
        mesh = problem.u.function_space.mesh
        weight = problem.contacts[0].inputs.weight if problem.contacts else 1.0
        degree = problem.displacement.degree
        dx = ufl.dx(mesh, metadata={"quadrature_degree": 2 * degree})
        self.stress, recovered_strain = _project_tensors(mesh, [stress, strain], degree, weight, dx)
        error = ufl.inner(self.stress - stress, recovered_strain - strain)
        q = ufl.TestFunction(fem.functionspace(mesh, ("DG", 0)))
        both = [weight * q * density * dx for density in (error, ufl.inner(stress, strain))]
        n = mesh.topology.index_map(mesh.topology.dim).size_local

        self.squares, energies = (
            fem.assemble_vector(compile_form(form)).array[:n].copy() for form in both
        )
        total, self.twice_energy = global_sum(mesh.comm, [self.squares.sum(), energies.sum()])
        self.ratio = abs(total / self.twice_energy) if self.twice_energy else 0.0


def _discretisation_errors(
    problem: ContactProblem, recovery: _StressRecovery, values: Mapping[str, float]
) -> dict[str, float]:
    """Return the discretisation errors of the quantities.

    The error η²/2 of the potential energy, divided by the elastic energy, is the relative error of
    the force at prescribed displacements, or of the displacement under prescribed forces. The error
    of friction follows from its ratio to the normal force by the recovered stress on Γc, that of
    the peak from the pressure smoothed on Γc.
    """
    contacts, mesh = problem.contacts, problem.u.function_space.mesh
    state, twice, ratio = problem.present_state(), recovery.twice_energy, recovery.ratio
    work = float(global_sum(mesh.comm, problem.present.load @ state))
    by_loads = float(np.clip(work / twice, 0.0, 1.0)) if twice else 0.0
    by_displacements = 1.0 - by_loads
    errors: dict[str, float] = {}
    for contact in contacts:
        d, normals = mesh.geometry.dim, contact.values.normal
        plane = ufl.as_tensor([[recovery.stress[i, j] for j in range(d)] for i in range(d)])
        outward = ufl.dot(plane, ufl.FacetNormal(mesh))
        traction = PointEvaluator(contact.quadrature, {"traction": outward})()["traction"]
        normal = np.sum(traction * normals, axis=1)
        tangential = np.linalg.norm(traction - normal[:, None] * normals, axis=1)
        closed = contact.status != Status.OPEN
        measure = contact.measure * closed
        recovered = global_sum(mesh.comm, [-measure @ normal, measure @ tangential])
        r = contact.resultants()
        error = ratio * by_displacements * r.normal_force
        # Recovery spreads traction beyond the contact zone, but keeps the ratio of its components.
        scale = (r.normal_force - error) / recovered[0] if recovered[0] > 0 else 1.0
        friction = r.tangential_force - scale * recovered[1]
        if contact.law.has_friction and not contact.law.has_potential and not r.stick:
            # All points slip: friction is proportional to the pressure.
            friction = error * r.tangential_force / (r.normal_force or 1.0)
        peak = r.max_pressure - _smooth_peak(contact)
        errors |= _name_values(problem, contact, error, friction, peak)
    if not np.any(global_sum(mesh.comm, np.abs(problem.present.load).sum())):
        by_loads = 0.0 if _is_largest_prescribed(problem, state) else 1.0
    errors[DISPLACEMENT] = -ratio * by_loads * values[DISPLACEMENT]
    return errors


def _smooth_peak(contact: Contact) -> float:
    """Return the peak of the facet means of the pressure, smoothed on Γc. Collective.

    Stresses recovered in the bulk are less accurate at a boundary. Means and linear functions of
    order h² suffice for any degree, since the pressure ends with a square root.
    """
    quadrature, submesh = contact.quadrature, contact.surface.submesh
    n_cells = submesh.topology.index_map(submesh.topology.dim).size_local
    points = quadrature.space().dofmap.list[:n_cells]
    weights, pressure = quadrature.weights[points], contact.pressure[points]
    space = fem.functionspace(submesh, ("DG", 0))
    mean, loaded = fem.Function(space), fem.Function(space)
    cells = space.dofmap.list[:n_cells, 0]
    mean.x.array[cells] = np.sum(weights * pressure, axis=1) / np.sum(weights, axis=1)
    loaded.x.array[cells] = np.any(pressure > 0, axis=1)
    for function in (mean, loaded):
        function.x.scatter_forward()
    smooth = _project(submesh, [mean], 1, loaded, ufl.dx(submesh))
    at_points = PointEvaluator(quadrature, {"pressure": smooth[0]})()["pressure"]
    return global_max(submesh.comm, at_points)


def _is_largest_prescribed(problem: ContactProblem, state: Array) -> bool:
    n = problem.full.unknowns.n_dofs
    prescribed, size = problem.full.constrained[:n], np.abs(state[:n])
    comm = problem.u.function_space.mesh.comm
    return global_max(comm, size[prescribed]) >= global_max(comm, size[~prescribed])


def _project_tensors(
    mesh: dolfinx.mesh.Mesh, tensors: list[Any], degree: int, weight: Any, dx: ufl.Measure
) -> list[Any]:
    """Project symmetric tensors onto continuous functions of a degree in L². Collective."""
    pairs = [(t, i, j) for t in tensors for i in range(t.ufl_shape[0]) for j in range(i + 1)]
    projected = _project(mesh, [t[i, j] for t, i, j in pairs], degree, weight, dx)
    index = {(id(t), i, j): c for c, (t, i, j) in enumerate(pairs)}
    return [
        ufl.as_tensor(
            [
                [projected[index[id(t), max(i, j), min(i, j)]] for j in range(t.ufl_shape[0])]
                for i in range(t.ufl_shape[0])
            ]
        )
        for t in tensors
    ]


def _project(
    mesh: dolfinx.mesh.Mesh, scalars: list[Any], degree: int, weight: Any, dx: ufl.Measure
) -> fem.Function:
    """Project scalars onto continuous functions of a degree in L², as one vector. Collective.

    Projections vanish at nodes around which the weight is zero.
    """
    space = fem.functionspace(mesh, ("Lagrange", degree))
    p, q = ufl.TrialFunction(space), ufl.TestFunction(space)
    mass = fem.petsc.assemble_matrix(compile_form(weight * p * q * dx))
    mass.assemble()
    blocked = fem.functionspace(mesh, ("Lagrange", degree, (len(scalars),)))
    rhs = fem.Function(blocked)
    form = weight * ufl.dot(ufl.as_vector(scalars), ufl.TestFunction(blocked)) * dx
    assemble_values(compile_form(form), rhs.x)
    ksp = create_mass_solver(mass, rtol=1e-8)
    component, projections = fem.Function(space), fem.Function(blocked)
    for c in range(len(scalars)):
        component.x.array[:] = rhs.x.array[c :: len(scalars)]
        solution = fem.Function(space)
        ksp.solve(component.x.petsc_vec, solution.x.petsc_vec)
        solution.x.scatter_forward()
        projections.x.array[c :: len(scalars)] = solution.x.array
    ksp.destroy()
    mass.destroy()
    return projections
