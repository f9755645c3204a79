"""Verification cases with closed solutions: flat punch, wavy surface, cylinder on block."""

from __future__ import annotations

from collections.abc import Iterator

import dolfinx
import gmsh
import numpy as np
import ufl
from dolfinx import fem

import fenics_contact as fc
from scenes.bodies import COMM, Bodies, boxes, graded
from scenes.tags import any_of, at_coordinate
from verification.cases import Estimate, Outcome, Row, case

GROUND, LOAD, AXIS, SURFACE, OPPOSITE = 1, 2, 3, 4, 5


@case(
    "Rigid flat punch on a half-plane",
    "0.5 %: half-plane truncated at 50 a; singular pressure at the corner, cells of a/160",
    reason_without_estimates="the force is given; peak pressure and displacement are infinite",
)
def flat_punch() -> Outcome:
    """Press a flat punch by a force (half modelled); compare pressure and load in |x| ≤ 0.9 a."""
    a, force, far = 1.0, 1.0, 50.0
    # Graded towards the corner from both sides.
    fine = graded(0.05, 8, 1.0, 1.15)
    x = np.concatenate([(a - fine)[::-1], a + graded(0.05, 8, far - a, 1.15)[1:]])
    y = -graded(0.05, 8, far, 1.15)[::-1]
    sides = {
        GROUND: at_coordinate(1, -far),
        AXIS: at_coordinate(0, 0),
        SURFACE: lambda x, cell: at_coordinate(1, 0)(x, cell) & (x[:, 0] < a),
    }
    body = Bodies(boxes([[x, y]], sides), 1000.0, 0.3, degree=2)
    body.prescribe(GROUND, 0, 1)
    body.prescribe(AXIS, 0)
    punch = fc.HalfSpace((0, 0), (0, -1), displacement=fc.Motion(force=(None, -force / 2)))
    contact = body.contact(SURFACE, punch, fc.Frictionless(fc.RelativeStiffness(100)))
    problem = body.problem(contact)
    problem.solve()
    points = contact.gather()
    along, p = points["x"][:, 0], points["pressure"]
    inside = along <= 0.9 * a
    exact = force / (np.pi * np.sqrt(a**2 - along[inside] ** 2))
    source = "p = P/(π√(a² - x²))"
    rows = [
        Row(
            f"p({at:g} a) a/P",
            float(np.interp(at, along, p)),
            1 / np.pi / np.sqrt(1 - at**2),
            source,
            0.005,
        )
        for at in (0.0, 0.5, 0.8)
    ]
    worst = float(np.abs(p[inside] / exact - 1).max())
    rows.append(Row("largest error of p, |x| ≤ 0.9 a", worst, 0.0, source, 0.005))
    share = 2 * float(points["measure"][inside] @ p[inside]) / force
    source = "(2/π) arcsin 0.9"
    rows.append(
        Row("load in |x| ≤ 0.9 a / total load", share, 2 / np.pi * np.arcsin(0.9), source, 0.005)
    )
    return Outcome(tuple(rows), f"{len(x) - 1} × {len(y) - 1} quadrilaterals, degree 2", body.dofs)


@case(
    "Wavy surface, Westergaard",
    "1 %: half a cell is 0.6 % of a/λ = 1/6; the penalty of 10 E/h reduces the amplitude by "
    "about 0.1 %",
)
def wavy(n: int = 256) -> Outcome:
    """Press an elastic half-plane on a rigid wave by p*/4, p*/2 and 3p*/4.

    Half a wave is modelled, with ``n`` cells.
    """
    wave, height = 1.0, 1.5
    modulus, nu, amplitude = 1000.0, 0.3, 1e-3
    full = np.pi * modulus / (1 - nu**2) * amplitude / wave
    y = graded(8 * wave / 2 / n, 8, height, 1.2)
    sides = {
        SURFACE: at_coordinate(1, 0),
        LOAD: at_coordinate(1, height),
        AXIS: any_of(at_coordinate(0, 0), at_coordinate(0, wave / 2)),
    }
    body = Bodies(boxes([[np.linspace(0, wave / 2, n + 1), y]], sides), modulus, nu)
    body.prescribe(AXIS, 0)
    load = body.constant(0.0)
    body.F += load * body.v[1] * body.ds(LOAD)
    gap = amplitude * (1 - ufl.cos(2 * np.pi / wave * body.x[0]))
    contact = body.contact(SURFACE, fc.PrescribedGap(gap, (0, -1)), fc.Frictionless())
    problem = body.problem(contact)
    rows = []
    for share, width, peak in (
        (0.25, 1 / 6, 4.0),
        (0.5, 0.25, 8**0.5),
        (0.75, 1 / 3, 16 / 48**0.5),
    ):
        mean = share * full
        load.value = mean
        problem.solve()
        problem.commit()
        points = contact.gather()
        x, p = points["x"][:, 0], points["pressure"]
        source = f"Westergaard, p̄ = {share:g} p*"
        rows.append(
            Row(f"a/λ at {share:g} p*", contact.resultants().area / wave, width, source, 0.01)
        )
        rows.append(Row(f"p(0)/p̄ at {share:g} p*", float(p[0] / mean), peak, source, 0.01))
        s, sx = np.sin(np.pi * width), np.sin(np.pi * x / wave)
        exact = 2 * mean * np.cos(np.pi * x / wave) / s**2 * np.sqrt(np.maximum(s**2 - sx**2, 0))
        rms = np.sqrt(points["measure"] @ (p - exact) ** 2 / (points["measure"] @ exact**2))
        rows.append(Row(f"L² error of p(x) at {share:g} p*", float(rms), 0.0, source, 0.01))

    def estimates() -> Iterator[Estimate]:
        # At the depth of 1.5 waves the solution has decayed by exp(-3π).
        budget = fc.estimate_errors(problem, body.stress)
        yield Estimate("peak pressure", budget, peak * mean, np.exp(-3 * np.pi))

    made = f"{n} × {len(y) - 1} quadrilaterals"
    return Outcome(tuple(rows), made, body.dofs, estimates=estimates)


def cylinder_on_block(h: float):
    """Mesh half of a cylinder of radius 50 on half of a block of 200 × 200, in mm. Collective.

    At the contact cells have size ``h`` on the block, and 0.8 ``h`` on the cylinder.
    """
    radius, side = 50.0, 200.0
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        gmsh.model.add("cylinder on block")
        if COMM.rank == 0:
            occ = gmsh.model.occ
            foot, centre = occ.addPoint(0, 0, 0), occ.addPoint(0, radius, 0)
            wide, steep = 0.4, np.pi - 0.2  # angles: end of Γc, and start of the load

            def on(angle: float) -> int:
                return occ.addPoint(radius * np.sin(angle), radius * (1 - np.cos(angle)), 0)

            near_end, shoulder, cap = on(wide), on(steep), occ.addPoint(0, 2 * radius, 0)
            arc = occ.addCircleArc(foot, centre, near_end)
            flank = occ.addCircleArc(near_end, centre, shoulder)
            top = occ.addCircleArc(shoulder, centre, cap)
            axis = occ.addLine(cap, foot)
            occ.addPlaneSurface([occ.addCurveLoop([arc, flank, top, axis])], 1)
            corner = [(0, 0), (20, 0), (side / 2, 0), (side / 2, -side), (0, -side)]
            points = [occ.addPoint(x, y, 0) for x, y in corner]
            lines = [
                occ.addLine(p, q) for p, q in zip(points, points[1:] + points[:1], strict=True)
            ]
            occ.addPlaneSurface([occ.addCurveLoop(lines)], 2)
            occ.synchronize()
            gmsh.model.addPhysicalGroup(2, [1], 1)
            gmsh.model.addPhysicalGroup(2, [2], 2)
            groups = {
                GROUND: [lines[3]],
                LOAD: [top],
                AXIS: [axis, lines[4]],
                SURFACE: [arc],
                OPPOSITE: [lines[0]],
            }
            for tag, group in groups.items():
                gmsh.model.addPhysicalGroup(1, group, tag)

            def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                away = max(0.0, np.hypot(x, y) - 9.0)
                return (0.8 if y > 0 else 1.0) * h + 0.15 * away

            gmsh.model.mesh.setSizeCallback(size)
            gmsh.model.mesh.generate(2)
            gmsh.model.mesh.setOrder(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, COMM, gdim=2)
        return mesh, tags
    finally:
        gmsh.finalize()


@case(
    "Cylinder on block, two bodies, NAFEMS R0094-1",
    "1.5 % = (a/R)²: Hertz's theory assumes a parabola and parallel normals",
)
def cylinder(h: float = 0.25, stiffness: float = 10.0) -> Outcome:
    """Press a steel cylinder on a block of 70 GPa by 35 kN/mm, without friction.

    Cells at the contact have size ``h``; the penalty is ``stiffness`` E/h.
    """
    made = cylinder_on_block(h)
    body = Bodies(made, _moduli(made[0], 210e3, 70e3), 0.3, degree=2)
    body.prescribe(GROUND, 0, 1)
    body.prescribe(AXIS, 0)
    total = 35e3
    # The traction on the cap of the cylinder has the given resultant.
    width = _integral(body, LOAD)
    load = body.constant(0.0)
    body.F += load / width * body.v[1] * body.ds(LOAD)
    contact = body.contact(SURFACE, OPPOSITE, fc.Frictionless(fc.RelativeStiffness(stiffness)))
    problem = body.problem(contact)
    list(fc.increments(problem, load, 0.0, total / 2, steps=2))
    r, points = contact.resultants(), contact.gather()
    rows = (
        Row("contact force per half [N/mm]", r.force[1], total / 2, "applied load", 1e-6),
        Row("half-width a [mm]", _half_width(points), 6.2146, "Hertz", 0.015),
        Row("peak pressure p₀ [MPa]", r.max_pressure, 3585.4, "Hertz", 0.015),
    )

    def estimates() -> Iterator[Estimate]:
        budget = fc.estimate_errors(problem, body.stress)
        yield Estimate("peak pressure", budget, 3585.4, (6.2146 / 50) ** 2)

    n = body.mesh.topology.index_map(2).size_global
    words = f"2 bodies, {n} curved triangles, h = a/{6.2146 / h:.0f}, degree 2"
    return Outcome(rows, words, body.dofs, estimates=estimates)


def _moduli(mesh: dolfinx.mesh.Mesh, upper: float, lower: float) -> fem.Function:
    """Return Young's modulus above and below y = 0, one value per cell."""
    E = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    middle = E.function_space.tabulate_dof_coordinates()[:, 1]
    E.x.array[:] = np.where(middle > 0, upper, lower)
    return E


def _integral(body: Bodies, tag: int) -> float:
    one = body.constant(1.0)
    return float(COMM.allreduce(fem.assemble_scalar(fem.form(one * body.ds(tag)))))


def _half_width(points) -> float:
    """Return the end of the contact, interpolated between the last closed and first open point."""
    x, gap = points["x"][:, 0], points["gap"]
    i = int(np.flatnonzero(gap < 0)[-1])
    return float(x[i] + (x[i + 1] - x[i]) * gap[i] / (gap[i] - gap[i + 1]))
