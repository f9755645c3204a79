"""Problems with extreme parameters: finite kinematics with rigid obstacles.

As in `extreme_scenes` a problem is a function of the method that returns the steps and the relative
error. If not stated otherwise, a rubber block with a fixed bottom is under a rigid tool.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean
from scenes.blocks import BOTTOM, LEFT, TOP, block_mesh
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.rubber import TIGHT_TOLERANCE, DiscOnRubber, rubber
from scenes.surfaces import box, circle, ring
from verification import finite_reference, finite_scenes
from verification.extreme_scenes import Array, Solve

E, NU = 1000.0, 0.3
RADIUS, DEPTH = 0.8, 0.1


def relative_error(found: Any, wanted: Any) -> float:
    """Return the largest difference relative to the largest expected value."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


def _press_disc(mu: float, method: str, **options: Any) -> tuple[DiscOnRubber, list[fc.Step]]:
    """Press the disc into the block by `DEPTH`."""
    law = fc.Coulomb(mu, 1e4, 1e4) if mu else fc.Frictionless(1e4)
    solver = {"petsc_options": TIGHT_TOLERANCE, "method": method}
    tool = DiscOnRubber(law=law, radius=RADIUS, solver=solver, **options)
    return tool, [tool.solve_increment(0.0, -0.5 * DEPTH), tool.solve_increment(0.0, -DEPTH)]


def _move(tool: DiscOnRubber, end: Any, steps: int) -> list[fc.Step]:
    """Move the tool in equal increments to a lateral and a vertical displacement and an angle."""
    start = np.array([tool.shift.value[0], tool.shift.value[-1], float(tool.angle.value)])

    def load(t: float) -> None:
        side, up, angle = start + t * (np.asarray(end) - start)
        tool.shift.value[:], tool.angle.value = tool.vector(side, up), angle

    return list(fc.increments(tool.problem, load, steps=steps))


# ---- rotation and sliding ------------------------------------------------------------------------


def rotate_disc(angle: float, steps: int, mu: float = 0.3, **options: Any) -> Solve:
    """Press and rotate a disc; the friction moment is ∫ μ p times the distance from its axis.

    All points slip after some rotation.
    """

    def solve(method: str) -> tuple[list[fc.Step], float]:
        tool, made = _press_disc(mu, method, **options)
        made += _move(tool, (0.0, -DEPTH, angle), steps)
        contact, centre = tool.contact, np.array([0.0, tool.scene.height + RADIUS - DEPTH])
        arm = np.linalg.norm(contact.points + contact.pairs.own_displacement() - centre, axis=1)
        wanted = np.sign(angle) * mu * (contact.measure * arm) @ contact.pressure
        return made, relative_error(contact.moment(centre), wanted)

    return solve


def rotate_together(steps: int, angle: float = 2 * np.pi) -> Solve:
    """Press and slide, then rotate body and disc about the origin; tractions rotate with them.

    The bottom of the body moves as a rigid body.
    """

    def solve(method: str) -> tuple[list[fc.Step], float]:
        tool, made = _press_disc(0.3, method)
        made += [tool.solve_increment(0.05, -DEPTH)]
        before, place = tool.tractions(), tool.vector(0.05, -DEPTH)
        centre = tool.vector(0.0, tool.scene.height + RADIUS)

        def load(t: float) -> None:
            c, s = np.cos(t * angle), np.sin(t * angle)
            matrix = np.array([[c, -s], [s, c]])
            tool.scene.move_bottom(lambda x: matrix @ x)
            tool.shift.value[:] = matrix @ (centre + place) - centre
            tool.angle.value = t * angle

        made += list(fc.increments(tool.problem, load, steps=steps))
        return made, relative_error(tool.tractions(), before)

    return solve


def slide_over_facets(n: int, steps: int, distance: float) -> Solve:
    """Slide a block by ``distance`` under a plane of n facets; reference: a half-space."""

    def force(method: str, obstacle: Any) -> tuple[list[fc.Step], Array]:
        scene = rubber(n=(8, 4))
        shift = fem.Constant(scene.mesh, np.zeros(2))
        options = {"method": method, "petsc_options": TIGHT_TOLERANCE}
        problem, contact = scene.problem(obstacle(shift), fc.Coulomb(0.3, 1e4, 1e4), **options)

        def press(t: float) -> None:
            shift.value[:] = 0.0, -0.05 * t

        def drag(t: float) -> None:
            shift.value[:] = distance * t, -0.05

        made = list(fc.increments(problem, press, steps=1))
        made += list(fc.increments(problem, drag, steps=steps))
        return made, contact.resultants().force

    def facets(shift: Any) -> fc.RigidSurface:
        x = np.linspace(-3.0 - distance, 3.0 + distance, n + 1)
        points = np.column_stack([x, np.ones(n + 1)])
        numbers = np.column_stack([np.arange(n), np.arange(1, n + 1)])
        return fc.RigidSurface(points, numbers, displacement=shift)

    def plane(shift: Any) -> fc.HalfSpace:
        return fc.HalfSpace((0.0, 1.0), (0.0, -1.0), displacement=shift)

    def solve(method: str) -> tuple[list[fc.Step], float]:
        made, found = force(method, facets)
        return made, relative_error(found, force(method, plane)[1])

    return solve


def rotate_drum(n: int, steps: int, angle: float) -> Solve:
    """Rotate a drum of n facets under pressure; reference: a circular drum."""

    def force(method: str, obstacle: Any) -> tuple[list[fc.Step], Array]:
        scene = rubber(n=(12, 6))
        shift, turn = fem.Constant(scene.mesh, np.zeros(2)), fem.Constant(scene.mesh, 0.0)
        centre = (0.0, scene.height + RADIUS)
        move = {"displacement": shift, "rotation": fc.Rotation(turn, centre)}
        options = {"method": method, "petsc_options": TIGHT_TOLERANCE}
        law = fc.Coulomb(0.3, 1e4, 1e4)
        problem, contact = scene.problem(obstacle(centre, move), law, **options)

        def press(t: float) -> None:
            shift.value[1] = -DEPTH * t

        def rotate(t: float) -> None:
            turn.value = angle * t

        made = list(fc.increments(problem, press, steps=2))
        made += list(fc.increments(problem, rotate, steps=steps))
        return made, contact.resultants().force

    def solve(method: str) -> tuple[list[fc.Step], float]:
        made, found = force(
            method, lambda c, move: fc.RigidSurface(circle(n, RADIUS, c), ring(n), **move)
        )
        return made, relative_error(found, force(method, lambda c, m: fc.Ball(c, RADIUS, **m))[1])

    return solve


def slide_off(mu: float, steps: int, linear: bool = True) -> Solve:
    """Slide a block off the end of a plate.

    Reference: zero force; without friction also the initial force after return.
    """

    def solve(method: str) -> tuple[list[fc.Step], float]:
        scene = rubber(n=(8, 4), linear=linear)
        shift = fem.Constant(scene.mesh, np.zeros(2))
        corners, _ = box((-1.5, 1.0, -1.0), (1.5, 2.0, 1.0))
        flat = corners[[0, 1, 3, 2], :2]
        plate = fc.RigidSurface(flat, ring(4), displacement=shift)
        law = fc.Coulomb(mu, 1e4, 1e4) if mu else fc.Frictionless(1e4)
        options = {"method": method, "petsc_options": TIGHT_TOLERANCE}
        problem, contact = scene.problem(plate, law, **options)

        def move(start: Any, end: Any, steps: int) -> list[fc.Step]:
            def load(t: float) -> None:
                shift.value[:] = np.asarray(start) + t * (np.asarray(end) - np.asarray(start))

            return list(fc.increments(problem, load, steps=steps, max_cuts=6))

        made = move((0.0, 0.0), (0.0, -0.05), 1)
        first = contact.resultants().force
        made += move((0.0, -0.05), (3.0, -0.05), steps)
        off = contact.resultants().force
        if mu:
            return made, float(np.abs(off).max() / np.abs(first).max())
        made += move((3.0, -0.05), (0.0, -0.05), steps)
        back = contact.resultants().force
        return made, max(relative_error(back, first), float(np.abs(off).max()))

    return solve


# ---- strain, stiffness, first contact ------------------------------------------------------------


def column(
    kappa: float, stretch: float = 0.6, steps: int = 1, *, gap: float = 0.0, mu: float = 0.0
) -> Solve:
    """Compress a 1 x 1 column with free sides by a plane to a fraction of its height.

    Stretches are uniform: laterally the stress vanishes, axially the nominal stress is the contact
    pressure; both are determined by bisection. The displacement of the plane is prescribed.
    """
    n = (2, 4)
    k_n = kappa * E * n[1]

    def solve(method: str) -> tuple[list[fc.Step], float]:
        mesh, tags = block_mesh("quadrilateral", n=n, size=(1.0, 1.0))
        u = fem.Function(displacement_space(mesh, 2))
        body = NeoHookean(u, E, NU, "plane strain")
        bcs = [dirichlet_bc(u, tags, BOTTOM, 1), dirichlet_bc(u, tags, LEFT, 0)]
        shift = fem.Constant(mesh, np.zeros(2))
        plane = fc.HalfSpace((0.0, 1.0 + gap), (0.0, -1.0), displacement=shift)
        law = fc.Coulomb(mu, k_n, k_n) if mu else fc.Frictionless(k_n)
        surface = fc.ContactSurface(mesh, tags, TOP)
        contact = fc.Contact(u, surface, plane, law, kinematics="finite")
        F = body.residual(_test(u))
        problem = fc.ContactProblem(
            F, u, bcs=bcs, contacts=[contact], method=method, petsc_options=TIGHT_TOLERANCE
        )
        down = gap + 1.0 - stretch

        def load(t: float) -> None:
            shift.value[1] = -down * t

        made = list(fc.increments(problem, load, steps=steps))
        wanted = bisect(lambda s: stress(s) + k_n * (s - stretch), stretch * 0.5, 1.0)
        found = 1.0 + u.x.array.reshape(-1, 2)[:, 1].min()
        return made, abs(found - wanted) / (1.0 - wanted)

    return solve


def _test(u: fem.Function) -> Any:
    import ufl

    return ufl.TestFunction(u.function_space)


def nominal(along: float, across: float) -> tuple[float, float]:
    """Return axial and lateral nominal stress of a column in plane strain."""
    shear, lame = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    volume = 0.5 * lame * ((along * across) ** 2 - 1)
    return tuple(shear * (s - 1 / s) + volume / s for s in (along, across))


def stress(along: float) -> float:
    """Return the axial nominal stress of a column with free sides."""
    across = bisect(lambda s: nominal(along, s)[1], 0.5, 5.0)
    return nominal(along, across)[0]


def bisect(function: Any, low: float, high: float) -> float:
    """Return the zero of an increasing function."""
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) < 0 else (low, middle)
    return 0.5 * (low + high)


def against_solver(
    kappa: float, mu: float, bulk: str = "rubber", steps: int = 2, **change: Any
) -> Solve:
    """Press a block on a disc and slide it; compare with the solver of the random scenes.

    That solver shares the assembly of the bulk with the package.
    """
    law: dict[str, Any] = {"kind": "coulomb" if mu else "frictionless"}
    law |= {"k_n": ["number", 4 * kappa]} | ({"k_t": ["number", 4 * kappa]} if mu else {})
    law |= {"friction": mu} if mu else {}
    obstacle = {"kind": "ball", "clearance": 0.0, "radius": 1.0, "moving": "displacement"}
    obstacle |= {"turn": "middle"}
    body = {"origin": [0.0, 0.0], "size": [1.0, 1.0], "n": [6, 4], "E": E, "jitter": 0}
    stages = [
        {"steps": steps, "normal": 1.0, "side": 0.0, "across": 0.0, "turn": 0.0},
        {"steps": steps, "normal": 1.0, "side": 0.05, "across": 0.0, "turn": 0.3},
    ]
    scene = {"kinematics": "finite", "bulk": bulk, "layout": "floor", "cell": "quadrilateral"}
    scene |= {"degree": 1, "nu": NU, "bodies": [body], "units": [1.0, 1.0], "drive": "obstacle"}
    scene |= {"contacts": [{"body": 0, "side": "bottom", "obstacle": obstacle, "law": law}]}
    scene |= {"dirichlet": [[0, "top", [0, 1], "fixed"]], "strain": 0.1, "load_ratio": 1.0}
    scene |= {"stages": stages} | change

    return compare_with_independent_solver(
        scene, finite_scenes.FiniteSetup, finite_reference.make_problem
    )


def compare_with_independent_solver(
    scene: dict[str, Any], setup_class: Any, make_problem: Any
) -> Solve:
    """Solve the history of a random scene; compare the forces with the independent solver.

    Args:
        scene: The scene, without a method.
        setup_class: Setup class of the scene, in `finite_scenes` or `sliding_scenes`.
        make_problem: Function that creates the problem of the independent solver.
    """

    def solve(method: str) -> tuple[list[fc.Step], float | None]:
        setup = setup_class(scene | {"method": method}, MPI.COMM_WORLD)
        problem = setup.problem()
        other, _, loads = make_problem(scene)
        old = [c.initial_state() for c in other.contacts]
        u, motion = np.zeros(other.body.nodes_x.size), np.zeros(0)
        is_solved, steps, largest_error = True, [], 0.0
        for stage, given in enumerate(scene["stages"]):
            for step in fc.increments(
                problem, lambda t, s=stage: setup.apply(s, t), steps=given["steps"]
            ):
                steps.append(step)
                if not is_solved:
                    continue
                load = loads(stage, step.load)
                try:
                    u, motion, old = other.solve(u, motion, load, old)
                except (finite_reference.NotSolved, np.linalg.LinAlgError):
                    is_solved = False
                    continue
                found = other.evaluate(u, motion, load, old)
                pairs = zip(other.contacts, found, old, strict=True)
                old = [c.next_state(f, o) for c, f, o in pairs]
                force = other.contacts[0].weights @ found[0]["traction"]
                largest_error = max(
                    largest_error, relative_error(step.contacts["contact 0"].force, force)
                )
        return steps, largest_error if is_solved else None

    return solve


def close_gap(gap: float, by_force: bool = False) -> Solve:
    """Close a gap by the disc in one increment; reference: the force without gap, or the load."""

    def force(method: str, gap: float) -> tuple[list[fc.Step], Array]:
        scene = rubber(n=(12, 6))
        shift: Any = fem.Constant(scene.mesh, np.zeros(2))
        push = fem.Constant(scene.mesh, -60.0)
        if by_force:
            shift = fc.Motion(force=(None, push), displacement=(0.0, None))
        disc = fc.Ball((0.0, scene.height + RADIUS + gap), RADIUS, displacement=shift)
        options = {"method": method, "petsc_options": TIGHT_TOLERANCE}
        problem, contact = scene.problem(disc, fc.Frictionless(1e4), **options)

        def load(t: float) -> None:
            if by_force:
                push.value = -60.0 * t
            else:
                shift.value[1] = -(gap + 0.05) * t

        made = list(fc.increments(problem, load, steps=1, max_cuts=10))
        return made, contact.resultants().force

    def solve(method: str) -> tuple[list[fc.Step], float]:
        made, found = force(method, gap)
        # The mesh is not symmetric: a prescribed displacement has a lateral reaction.
        return made, relative_error(found[1], -60.0 if by_force else force(method, 0.0)[1][1])

    return solve


def indent(steps: int, down: float = 0.3, **options: Any) -> Solve:
    """Press the disc into the block without friction; reference: 16 increments."""

    def force(method: str, steps: int) -> tuple[list[fc.Step], Array]:
        solver = {"petsc_options": TIGHT_TOLERANCE, "method": method}
        tool = DiscOnRubber(law=fc.Frictionless(1e4), radius=RADIUS, solver=solver, **options)
        return _move(tool, (0.0, -down, 0.0), steps), tool.resultant()

    def solve(method: str) -> tuple[list[fc.Step], float]:
        made, found = force(method, steps)
        return made, relative_error(found, force(method, 16)[1])

    return solve
