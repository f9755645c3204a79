"""Verification cases with references independent of the mesh: statics, patch test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

import fenics_contact as fc
from scenes.bodies import COMM, Bodies, boxes
from scenes.tags import any_of, at_coordinate, at_interface
from verification.cases import Estimate, Outcome, Row, case

BASE, TOP, LEFT, RIGHT, SEAT = 1, 2, 3, 4, 5


def block(n: tuple[int, int], size: tuple[float, float] = (1.0, 1.0), **kwargs):
    """Mesh a rectangle with tagged sides."""
    axes = [[np.linspace(0, length, k + 1) for k, length in zip(n, size, strict=True)]]
    sides = {
        BASE: at_coordinate(1, 0),
        TOP: at_coordinate(1, size[1]),
        LEFT: at_coordinate(0, 0),
        RIGHT: at_coordinate(0, size[0]),
    }
    return boxes(axes, sides, **kwargs)


@case(
    "Contact spring, Code_Aster SSND116A",
    "1e-6 as in the benchmark; the solver tolerance is 1e-9",
    reason_without_estimates="the contact stiffness is given; results are exact up to round-off",
)
def contact_spring() -> Outcome:
    """Solve a point on unit springs: k_n = 1, k_t = μ = gap = 0.5, N up to 1, T up to 2 and back.

    Springs, loads and contact act on the same points, so that the body translates.
    """
    body = Bodies(block((1, 1)), 1000.0, 0.3)
    force = body.constant([0.0, 0.0])
    body.F += ufl.dot(body.u - force, body.v) * body.ds(BASE)
    law = fc.Coulomb(0.5, k_n=1.0, k_t=0.5)
    contact = body.contact(BASE, fc.HalfSpace((0, 0), (0, 1)), law, gap=0.5)
    problem = body.problem(contact)
    history = [
        # N, T, component, reference
        (0.5, 0.0, 1, -0.5),
        (1.0, 0.0, 1, -0.75),
        (1.0, 0.2, 0, 0.133333333),
        (1.0, 2.0, 0, 1.875),
        (1.0, 1.8, 0, 1.741666667),
        (1.0, 0.0, 0, 0.125),
    ]
    rows = []
    for normal, tangential, i, reference in history:
        force.value[:] = tangential, -normal
        problem.solve()
        problem.commit()
        mean = [
            COMM.allreduce(fem.assemble_scalar(fem.form(body.u[j] * body.ds(BASE))))
            for j in range(2)
        ]
        quantity = f"{'u_t' if i == 0 else 'u_n'} at N = {normal:g}, T = {tangential:g}"
        rows.append(Row(quantity, mean[i], reference, "Code_Aster SSND116A", 1e-6))
    return Outcome(tuple(rows), "1 quadrilateral", body.dofs)


SLOPE = 0.1
WEIGHT = 3058.0  # N per thickness


@case(
    "Wedge on a wedge, NAFEMS CGS-4",
    "1e-6: statics, which holds for elastic bodies, too; the solver tolerance is 1e-9",
    reason_without_estimates="results follow from statics, up to round-off",
)
def wedge() -> Outcome:
    """Push an elastic wedge up another one, with non-matching meshes.

    The upper wedge of weight G is pushed by a frictionless rigid plate until all closed points
    slip; the force F of the plate follows from G and μ.
    """
    rows, dofs = [], 0
    for friction in (0.0, 0.1, 0.2, 0.3):
        long, short = np.linspace(0, 1200, 31), np.linspace(200, 800, 23)
        low, high = np.linspace(0, 1, 5), np.linspace(1, 2, 6)

        def bend(x: np.ndarray) -> np.ndarray:
            # y ≤ 1: from the base to the slope; y > 1: from the slope to a horizontal top.
            ramp = 200 + SLOPE * x[:, 0]
            y = np.where(x[:, 1] <= 1, x[:, 1] * ramp, ramp + (x[:, 1] - 1) * (500 - ramp))
            return np.column_stack([x[:, 0], y])

        sides = {
            BASE: at_coordinate(1, 0),
            SEAT: at_interface(1, 1, above=False),
            TOP: at_interface(1, 1, above=True),
            LEFT: lambda x, cell: at_coordinate(0, 200)(x, cell) & (cell[:, 1] > 1),
        }
        body = Bodies(boxes([[long, low], [short, high]], sides, bend=bend), 206e3, 0.3)
        body.prescribe(BASE, 0, 1)
        marked = fem.Function(fem.functionspace(body.mesh, ("DG", 0)))
        middle = marked.function_space.tabulate_dof_coordinates()
        marked.x.array[:] = middle[:, 1] > 200 + SLOPE * middle[:, 0]
        area = COMM.allreduce(fem.assemble_scalar(fem.form(marked * ufl.dx)))
        body.F += WEIGHT / area * marked * body.v[1] * ufl.dx
        move = body.constant([0.0, 0.0])
        law = fc.Coulomb(friction) if friction else fc.Frictionless()
        slope = body.contact(TOP, SEAT, law, name="slope")
        rigid = fc.HalfSpace((200, 0), (1, 0), displacement=move)
        plate = body.contact(LEFT, rigid, fc.Frictionless(), name="plate")
        problem = body.problem(slope, plate)
        for along in (0.0, 0.05, 0.1, 0.2):
            move.value[0] = along
            problem.solve()
            problem.commit()
        ratio = plate.resultants().normal_force / WEIGHT
        reference = (SLOPE + friction) / (1 - friction * SLOPE)
        source = "(tan α + μ)/(1 - μ tan α)"
        rows.append(Row(f"F/G, μ = {friction:g}", ratio, reference, source, 1e-6))
        dofs = body.dofs
    return Outcome(tuple(rows), "2 bodies, 30 × 4 and 22 × 5 quadrilaterals", dofs)


@case(
    "Belt on a drum (capstan)",
    "1 %, twice t/R = 0.005: the formula is for zero thickness",
    reason_without_estimates="the formula is accurate to t/R = 0.5 %, which exceeds the error",
)
def capstan() -> Outcome:
    """Pull a belt around half of a fixed drum until all points slip."""
    rows, dofs = [], 0
    radius, thickness, angle, tension, n = 100.0, 0.5, np.pi, 1.0, 240
    for friction in (0.1, 0.3):
        axes = [[np.linspace(0, angle, n + 1), np.array([0.0, thickness / 2, thickness])]]
        sides = {
            BASE: at_coordinate(1, 0),
            LEFT: at_coordinate(0, 0),
            RIGHT: at_coordinate(0, angle),
        }

        def bend(x: np.ndarray) -> np.ndarray:
            r = radius + x[:, 1]
            return np.column_stack([r * np.cos(x[:, 0]), r * np.sin(x[:, 0])])

        body = Bodies(boxes(axes, sides, bend=bend, degree=2), 1e4, 0.0, degree=2)
        pull, draw = body.constant(0.0), body.constant(0.0)
        body.prescribe(LEFT, 1, value=draw)  # at angle 0 the belt is parallel to y
        body.F += pull * body.v[1] * body.ds(RIGHT)
        law = fc.Coulomb(friction, k_n=20.0, k_t=20.0)
        contact = body.contact(BASE, fc.Cylinder((0, 0), radius), law)
        problem = fc.ContactProblem(
            body.F, body.u, bcs=body.bcs, contacts=[contact], method="newton"
        )
        list(fc.increments(problem, pull, 0.0, tension / thickness, steps=2))
        list(fc.increments(problem, draw, 0.0, -2.0, steps=8))
        r = contact.resultants()
        drawn = (r.force[1] - tension) / tension
        source = "exp(μθ), θ = π"
        rows.append(Row(f"T₂/T₁, μ = {friction:g}", drawn, np.exp(friction * angle), source, 0.01))
        rows.append(
            Row(f"number of sticking points, μ = {friction:g}", r.stick, 0.0, "full slip", 0.5)
        )
        dofs = body.dofs
    return Outcome(tuple(rows), f"{n} × 2 curved quadrilaterals, degree 2", dofs)


@case(
    "Block on an elastic incline",
    "1e-4: resolution of the bisection; 1e-6 for T/N: statics",
    reason_without_estimates="results follow from statics, up to round-off",
)
def incline() -> Outcome:
    """Find the steepest slope at which a block on an elastic base does not slide, by bisection.

    Gravity is rotated, not the mesh. Parts of the contact slip before the limit.
    """
    friction, weight = 0.3, 8.0
    axes = [
        [np.linspace(0, 3, 31), np.linspace(-1, 0, 7)],
        [np.linspace(1, 2, 13), np.linspace(0, 0.4, 6)],
    ]
    sides = {
        BASE: at_coordinate(1, -1),
        SEAT: at_interface(1, 0, above=False),
        TOP: at_interface(1, 0, above=True),
    }
    body = Bodies(boxes(axes, sides), 1000.0, 0.3)
    body.prescribe(BASE, 0, 1)
    tilt = body.constant(0.0)
    marked = fem.Function(fem.functionspace(body.mesh, ("DG", 0)))
    marked.x.array[:] = marked.function_space.tabulate_dof_coordinates()[:, 1] > 0
    pull = ufl.sin(tilt) * body.v[0] - ufl.cos(tilt) * body.v[1]
    body.F -= weight / 0.4 * marked * pull * ufl.dx
    contact = body.contact(TOP, SEAT, fc.Coulomb(friction))
    problem = body.problem(contact)
    largest_stable, smallest_sliding, largest_error = 0.0, 2.0, 0.0
    trials = [0.0, 0.5, 0.9]
    while smallest_sliding - largest_stable > 1e-4:
        slope_ratio = trials.pop(0) if trials else (largest_stable + smallest_sliding) / 2
        tilt.value = np.arctan(slope_ratio * friction)
        try:
            problem.solve()
        except (fc.NotConverged, ValueError):
            smallest_sliding = slope_ratio
            continue
        problem.commit()
        largest_stable = slope_ratio
        along, across = contact.resultants().force
        largest_error = max(largest_error, abs(-along / across - slope_ratio * friction) / friction)
    rows = (
        Row(
            "tan α at sliding / μ", (largest_stable + smallest_sliding) / 2, 1.0, "tan α = μ", 1e-4
        ),
        Row("largest |T/N - tan α| / μ", largest_error, 0.0, "statics", 1e-6),
    )
    return Outcome(rows, "2 bodies, 30 × 6 and 12 × 5 quadrilaterals", body.dofs)


@case(
    "Homogeneity of degree one",
    "1e-8: solver tolerance of 1e-12, amplified by the conditioning",
    reason_without_estimates="solutions are compared with each other",
)
def homogeneity() -> Outcome:
    """Load a block on a plane without gap proportionally, with open, stick and slip zones.

    Twice the load gives twice the displacements; four increments give the same result as one.
    """
    rows = []
    source = "homogeneous of degree one"
    made = block((20, 20), (40.0, 40.0))  # one mesh, as partitions differ
    for method in ("lbfgs", "newton"):
        one, _ = _sheared(made, method, 1.0, 1)
        twice, _ = _sheared(made, method, 2.0, 1)
        split, counts = _sheared(made, method, 1.0, 4)
        doubled = _norm(twice - 2 * one) / _norm(2 * one)
        rows += [
            Row(f"|u(2F) - 2u(F)| / |2u(F)|, {method}", doubled, 0.0, source, 1e-8),
            Row(
                f"|u(4 increments) - u| / |u|, {method}",
                _norm(split - one) / _norm(one),
                0.0,
                source,
                1e-8,
            ),
        ]
        every = min(counts.open, counts.stick, counts.slip) > 0
        rows.append(
            Row(f"open, stick and slip zones present, {method}", every, 1.0, "expected", 0.0)
        )
    return Outcome(tuple(rows), "20 × 20 quadrilaterals", 2 * 21**2)


def _sheared(made: Any, method: str, load: float, steps: int) -> tuple[np.ndarray, fc.Resultants]:
    """Solve the block of Raous; return the displacements of this rank and the resultants."""
    body = Bodies(made, 130e3, 0.2)
    body.prescribe(RIGHT, 0)
    grow = body.constant(0.0)
    body.F += 50 * grow * body.v[1] * body.ds(TOP) - 150 * grow * body.v[0] * body.ds(LEFT)
    contact = body.contact(BASE, fc.HalfSpace((0, 0), (0, 1)), fc.Coulomb(1.0))
    problem = fc.ContactProblem(
        body.F,
        body.u,
        bcs=body.bcs,
        contacts=[contact],
        petsc_options={"snes_rtol": 1e-12},
        method=method,
    )
    list(fc.increments(problem, grow, 0.0, load, steps=steps))
    n = body.u.function_space.dofmap.index_map.size_local * 2
    return body.u.x.array[:n].copy(), contact.resultants()


def _norm(x: np.ndarray) -> float:
    """Return the Euclidean norm over all ranks."""
    return float(np.sqrt(COMM.allreduce(x @ x)))


@case(
    "Patch test, non-matching meshes",
    "1e-9: solver tolerance, as penalty and projection are exact here; 2e-6 for exact contact, "
    "from which k_n = 1e12 differs by 1e-6",
)
def patch() -> Outcome:
    """Compress two confined blocks by 0.01: pressure and jump are uniform."""
    rows, k_n = [], 1e7
    solved = []  # problem, stress, and pressure of exact contact
    for nu in (0.0, 0.3):
        axes = [
            [np.linspace(0, 1, 4), np.linspace(0, 0.5, 3)],
            [np.linspace(0, 1, 6), np.linspace(0.5, 1, 3)],
        ]
        sides = {
            BASE: at_coordinate(1, 0),
            TOP: at_coordinate(1, 1),
            LEFT: any_of(at_coordinate(0, 0), at_coordinate(0, 1)),
            SEAT: at_interface(1, 0.5, above=False),
            RIGHT: at_interface(1, 0.5, above=True),
        }
        body = Bodies(boxes(axes, sides), 1e6, nu, degree=2)
        body.prescribe(BASE, 1)
        body.prescribe(LEFT, 0)
        body.prescribe(TOP, 1, value=-0.01)
        law = fc.Coulomb(0.3, k_n=k_n, k_t=1e6)
        contact = body.contact(SEAT, RIGHT, law)
        problem = body.problem(contact)
        problem.solve()
        give = (1 + nu) * (1 - 2 * nu) / (1 - nu) / 1e6
        solved.append((problem, body.stress, 0.01 / give))
        p = 0.01 / (give + 1 / k_n)
        points = contact.gather()
        for name, values, exact in (
            ("pressure", points["pressure"], p),
            ("jump", -points["gap"], p / k_n),
        ):
            farthest = values[np.argmax(np.abs(values - exact))]
            source = "uniform: 0.01/(1/M + 1/k_n)" if name == "pressure" else "p/k_n"
            rows.append(Row(f"{name}, farthest point, ν = {nu:g}", farthest, exact, source, 1e-9))
    # Nearly exact contact of the blocks with ν = 0: the jump is 1e-6 of the displacement.
    body = Bodies(boxes(axes, sides), 1e6, 0.0, degree=2)
    body.prescribe(BASE, 1)
    body.prescribe(LEFT, 0)
    body.prescribe(TOP, 1, value=-0.01)
    contact = body.contact(SEAT, RIGHT, fc.Frictionless(1e12))
    problem = body.problem(contact, method="newton")
    problem.solve()
    rows.append(
        Row("pressure, k_n = 1e12", contact.resultants().normal_force, 1e4, "E·0.01/H", 2e-6)
    )
    solved.append((problem, body.stress, 1e4))

    def estimates() -> Iterator[Estimate]:
        for problem, stress, exact in solved:
            budget = fc.estimate_errors(problem, stress)
            for quantity in ("normal force", "peak pressure"):  # the contact's length is 1
                yield Estimate(quantity, budget, exact)

    words = "2 bodies, 3 × 2 and 5 × 2 quadrilaterals, degree 2"
    return Outcome(tuple(rows), words, body.dofs, estimates=estimates)
