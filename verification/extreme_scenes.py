"""Problems with extreme parameters at small displacements.

The models are blocks on planes, discs and balls, two blocks, and a cylinder on a half-plane, solved
in one increment from the unloaded state if not stated otherwise. A problem is a function of the
method that returns the steps and the error relative to its reference.
"""

from __future__ import annotations

import functools
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.types import Array
from scenes.bodies import Bodies, boxes, graded
from scenes.meshes import partition_from_owners
from scenes.processes import command, subprocess_environment
from scenes.tags import at_coordinate

BOTTOM, TOP, LEFT, FRONT, OPPOSITE = 1, 2, 3, 4, 5
E, NU, PRESSURE = 1000.0, 0.3, 1.0

Solve = Callable[[str], tuple[list[fc.Step], float | None]]


class Block:
    """A rectangle or box with a corner at the origin and Γc at its bottom (last coordinate)."""

    def __init__(
        self,
        degree: int = 1,
        *,
        n: Sequence[int] = (8, 8),
        size: Sequence[float] | None = None,
        modulus: float = E,
        nu: float = NU,
        node_map: Callable[[Array], Array] | None = None,
        cell: str = "quadrilateral",
    ) -> None:
        """Create the mesh; ``node_map`` maps the nodes (2, n) of the unit square before scaling."""
        self.d = d = len(n)
        size = (1.0,) * d if size is None else size
        kind = dolfinx.mesh.CellType[cell if d == 2 or cell != "quadrilateral" else "hexahedron"]
        make = dolfinx.mesh.create_unit_square if d == 2 else dolfinx.mesh.create_unit_cube
        self.mesh = mesh = make(MPI.COMM_WORLD, *n, kind)
        if node_map is not None:
            mesh.geometry.x[:, :2] = node_map(mesh.geometry.x[:, :2].T).T
        sides = [(BOTTOM, d - 1, 0.0), (TOP, d - 1, 1.0), (LEFT, 0, 0.0)]
        sides += [(FRONT, 1, 0.0)] if d == 3 else []
        found = [
            dolfinx.mesh.locate_entities_boundary(
                mesh, d - 1, lambda x, i=i, at=at: np.abs(x[i] - at) < 1e-12
            )
            for _, i, at in sides
        ]
        facets = np.concatenate(found)
        values = np.repeat(np.array([s[0] for s in sides], np.int32), [len(f) for f in found])
        order = np.argsort(facets)
        self.tags = dolfinx.mesh.meshtags(mesh, d - 1, facets[order], values[order])
        mesh.geometry.x[:, :d] *= size
        self.size, self.modulus, self.nu = size, modulus, nu
        self.V = fem.functionspace(mesh, ("Lagrange", degree, (d,)))
        self.u, v = fem.Function(self.V), ufl.TestFunction(self.V)
        self.traction = fem.Constant(mesh, np.zeros(d))
        body = fc.elasticity.LinearElastic(self.u, modulus, nu, "plane strain" if d == 2 else "3D")
        ds = ufl.ds(mesh, subdomain_data=self.tags)
        self.F = body.residual(v) - ufl.dot(self.traction, v) * ds(TOP)
        self.surface = fc.ContactSurface(mesh, self.tags, BOTTOM)

    def fix(self, tag: int, component: int, value: Any = 0.0) -> fem.DirichletBC:
        """Return a Dirichlet condition for a component on a side."""
        if not isinstance(value, fem.Constant):
            value = fem.Constant(self.mesh, float(value))
        space = self.V.sub(component)
        dofs = fem.locate_dofs_topological(space, self.d - 1, self.tags.find(tag))
        return fem.dirichletbc(value, dofs, space)

    def rollers(self) -> list[fem.DirichletBC]:
        """Return the symmetry conditions at x = 0 and, in 3D, y = 0."""
        return [self.fix(LEFT, 0)] + ([self.fix(FRONT, 1)] if self.d == 3 else [])

    def prescribe_top(self, sideways: float, down: float) -> list[fem.DirichletBC]:
        """Return Dirichlet conditions that move the top along x and down."""
        across = [self.fix(TOP, 1)] if self.d == 3 else []
        return [self.fix(TOP, 0, sideways), *across, self.fix(TOP, self.d - 1, -down)]

    def problem(
        self, law: Any, obstacle: Any, bcs: list[fem.DirichletBC], **options: Any
    ) -> fc.ContactProblem:
        """Create the problem with one contact."""
        self.contact = fc.Contact(self.u, self.surface, obstacle, law)
        return fc.ContactProblem(self.F, self.u, bcs=bcs, contacts=[self.contact], **options)

    def plane(self, gap: float = 0.0) -> fc.HalfSpace:
        """Return a plane below the bottom."""
        up = np.eye(self.d)[-1]
        return fc.HalfSpace(-gap * up, up)

    def ball(self) -> fc.Ball:
        """Return a ball (disc) of twice the block's width that touches the centre of its bottom."""
        a = self.size[0]
        return fc.Ball([0.5 * a] * (self.d - 1) + [-2.0 * a], 2.0 * a)

    def compression_error(self, k_n: float, gap: float = 0.0, pressure: float = PRESSURE) -> float:
        """Return the relative error of the displacement under uniform pressure with free sides.

        σ = -p along the height; in plane strain u_y = -gap - p/k_n - (1 - ν²) p y/E and
        u_x = ν (1 + ν) p x/E; in space u_z = -gap - p/k_n - p z/E, u_x = ν p x/E, u_y = ν p y/E.
        """
        exact = fem.Function(self.V)
        along, across = strains(pressure / self.modulus, self.nu, self.d)
        exact.interpolate(
            lambda x: np.vstack(
                [*(across * x[: self.d - 1]), -gap - pressure / k_n - along * x[self.d - 1]]
            )
        )
        return difference(self.u, exact)


def strains(load: float, nu: float, d: int) -> tuple[float, float]:
    """Return compression along the load p/E and lateral extension, in plane strain or 3D."""
    return ((1 - nu**2) * load, nu * (1 + nu) * load) if d == 2 else (load, nu * load)


def difference(f: fem.Function, g: fem.Function) -> float:
    """Return the largest difference of two functions relative to the second. Collective."""
    comm = f.function_space.mesh.comm
    n = f.function_space.dofmap.index_map.size_local * f.function_space.dofmap.bs
    both = [float(np.abs(x).max(initial=0.0)) for x in ((f.x.array - g.x.array)[:n], g.x.array[:n])]
    error, size = comm.allreduce(np.array(both), op=MPI.MAX)
    return error / size if size else error


# ---- a block on a rigid obstacle -----------------------------------------------------------------


def friction_law(mu: float, k_n: Any, k_t: Any = None) -> Any:
    """Return Coulomb's law, or a frictionless one for μ = 0."""
    return fc.Coulomb(mu, k_n, k_n if k_t is None else k_t) if mu else fc.Frictionless(k_n)


def press_block(
    kappa: float,
    mu: float = 0.0,
    *,
    gap: float = 0.0,
    symmetric: bool = True,
    load: float = 1.0,
    history: int = 1,
    **block: Any,
) -> Solve:
    """Press a block on a plane by a uniform load, with symmetry conditions if ``symmetric``."""

    def solve(method: str) -> tuple[list[fc.Step], float]:
        body = Block(**block)
        h = body.size[-1] / block.get("n", (8, 8))[-1]
        k_n = kappa * body.modulus / h
        # The load is proportional to the modulus, so that strains are equal in all units.
        p = PRESSURE * load * body.modulus / E
        bcs = body.rollers() if symmetric else []
        problem = body.problem(friction_law(mu, k_n), body.plane(gap), bcs, method=method)

        def apply(t: float) -> None:
            body.traction.value[-1] = -p * t

        steps = list(fc.increments(problem, apply, steps=history))
        if mu == 0.0:
            return steps, body.compression_error(k_n, gap, p)
        force = p * float(np.prod(body.size[:-1]))
        return steps, abs(steps[-1].contacts["contact"].normal_force / force - 1)

    return solve


def compare_displacements(
    state: Callable[[str], tuple[list[fc.Step], Any]],
    reference: Callable[[], tuple[list[fc.Step], Any]],
) -> Solve:
    """Return a problem that compares u with a reference, which is solved once and may fail."""

    @functools.cache
    def other() -> fem.Function | None:
        try:
            return reference()[1].u
        except fc.NotConverged:
            return None

    def solve(method: str) -> tuple[list[fc.Step], float | None]:
        steps, body = state(method)
        return steps, None if other() is None else difference(body.u, other())

    return solve


def press_on_disc(
    kappa: float,
    mu: float,
    *,
    ratio: float = 1.0,
    depth: float = 0.03,
    lateral: float = 0.02,
    reference_method: str = "alternating",
    reference_stiffness: float | None = None,
    **block: Any,
) -> Solve:
    """Move the top of a block down and sideways on a disc or ball; compare u with another method.

    The reference has the stiffness ``reference_stiffness``, by default the same.
    """

    def state(method: str, kappa: float = kappa, **options: Any) -> tuple[list[fc.Step], Block]:
        body = Block(**block)
        length = body.size[0]
        bcs = body.prescribe_top(lateral * length, depth * length)
        law = friction_law(mu, fc.RelativeStiffness(kappa), fc.RelativeStiffness(kappa * ratio))
        problem = body.problem(law, body.ball(), bcs, method=method, **options)
        return [problem.solve()], body

    return compare_displacements(
        state, lambda: state(reference_method, reference_stiffness or kappa, fallback=False)
    )


State = tuple[fc.Step, Array]


def solve_block_in_units(method: str, modulus: float, length: float, n: Sequence[int]) -> State:
    """Solve the block on the disc; return the step, and u divided by the length of the block."""
    body = Block(modulus=modulus, size=(length,) * len(n), n=n)
    bcs = body.prescribe_top(0.02 * length, 0.03 * length)
    problem = body.problem(fc.Coulomb(0.3), body.ball(), bcs, method=method)
    return problem.solve(), body.u.x.array / length


def solve_in_other_units(
    modulus: float, length: float, n: Sequence[int] = (8, 8), scene: Any = solve_block_in_units
) -> Solve:
    """Solve in other units; the iterations must be equal, and the displacements are compared."""

    def solve(method: str) -> tuple[list[fc.Step], float]:
        step, u = scene(method, modulus, length, n)
        first, v = scene(method, E, 1.0, n)
        same = step.iterations == first.iterations
        return [step], float(np.abs(u - v).max() / np.abs(v).max()) if same else np.inf

    return solve


def poisson(nu: float, degree: int, d: int = 2) -> Solve:
    """Compare the contact force with that of half the mesh size and higher degree."""
    n, cell, best = (16, "triangle", 3) if d == 2 else (3, "hexahedron", 2)

    def solve(method: str) -> tuple[list[fc.Step], float]:
        step = _force(method, nu, degree, (n,) * d, cell)
        fine = _force("newton", nu, best, (2 * n,) * d, cell)
        ours, theirs = (s.contacts["contact"].normal_force for s in (step, fine))
        return [step], abs(ours / theirs - 1)

    return solve


@functools.lru_cache(maxsize=64)
def _force(method: str, nu: float, degree: int, n: tuple[int, ...], cell: str) -> fc.Step:
    body = Block(degree, n=n, nu=nu, cell=cell)
    problem = body.problem(
        fc.Frictionless(), body.ball(), body.prescribe_top(0.0, 0.03), method=method
    )
    return problem.solve()


def proportional(steps: int) -> Solve:
    """Apply a proportional load without gap, whose solution is independent of the increments."""

    def state(method: str, steps: int) -> tuple[list[fc.Step], Block]:
        body = Block(n=(4, 4))
        problem = body.problem(fc.Coulomb(0.5), body.plane(), [], method=method)

        def load(t: float) -> None:
            body.traction.value[:] = 0.2 * t, -1.0 * t

        return list(fc.increments(problem, load, steps=steps)), body

    def solve(method: str) -> tuple[list[fc.Step], float]:
        made, body = state(method, steps)
        _, once = state(method, 1)
        return made, difference(body.u, once.u)

    return solve


def cycle(path: list[tuple[float, float]], mu: float = 0.3) -> Solve:
    """Move the top along a path (sideways, down) and back to its first position.

    Reference: the force at the first position before the path.
    """

    def solve(method: str) -> tuple[list[fc.Step], float]:
        body = Block()
        move = [fem.Constant(body.mesh, 0.0) for _ in range(2)]
        bcs = [body.fix(TOP, i, c) for i, c in enumerate(move)]
        problem = body.problem(
            friction_law(mu, fc.RelativeStiffness(10)), body.plane(), bcs, method=method
        )
        steps = []
        for sideways, down in [path[0], *path, path[0]]:
            move[0].value, move[1].value = sideways, -down
            steps.append(problem.solve())
            problem.commit()
        forces = [step.contacts["contact"].normal_force for step in (steps[0], steps[-1])]
        opened = [s for s, (_, down) in zip(steps[1:], path, strict=False) if down < 0]
        if any(s.contacts["contact"].normal_force != 0.0 for s in opened):
            return steps, float("inf")
        return steps, abs(forces[1] / forces[0] - 1) if forces[0] else abs(forces[1])

    return solve


def load_block(side: float, up: float, mu: float, bcs: str, n: Sequence[int] = (8, 8)) -> Solve:
    """Load a block on a plane, and compare the contact force with the load."""

    def solve(method: str) -> tuple[list[fc.Step], float]:
        body = Block(n=n)
        conditions = {"free": [], "sides": body.rollers()}[bcs]
        problem = body.problem(
            friction_law(mu, fc.RelativeStiffness(10)), body.plane(), conditions, method=method
        )
        body.traction.value[0], body.traction.value[-1] = side, up
        step = problem.solve()
        wanted = -body.traction.value
        if bcs == "sides":
            wanted[:-1] = 0.0
        force = step.contacts["contact"].force - wanted
        return [step], float(np.abs(force).max() / max(abs(up), abs(side), 1e-300) if up else 0.0)

    return solve


def graded_to(ratio: float) -> Callable[[Array], Array]:
    """Return a map that grades cells along x by ``ratio`` from the centre of Γc to its ends."""

    def map_nodes(x: Array) -> Array:
        s = 2 * x[0] - 1
        growth = np.log(ratio)
        moved = np.sign(s) * np.expm1(growth * np.abs(s)) / np.expm1(growth)
        return np.vstack([0.5 + 0.5 * moved, x[1]])

    return map_nodes


# ---- one block on another ----------------------------------------------------------------------

MESHING_GAP = 0.25  # distance of the blocks during meshing, to distinguish their sides


class Pair:
    """Two blocks of height 1/2 and width 1 with non-matching meshes, one above the other.

    Attributes:
        moduli: Young's moduli of the lower and upper block.
        gap: Initial gap (length).
        traction: Traction on the top (force/length).
    """

    def __init__(
        self,
        *,
        modulus: float = E,
        contrast: float = 1.0,
        length: float = 1.0,
        gap: float = 0.0,
        n: tuple[int, int] = (6, 8),
        partitioner: Any = None,
    ) -> None:
        """Create the blocks; ``contrast``: ratio of moduli, ``gap``: gap divided by ``length``."""
        self.moduli, self.length, self.gap = (modulus, contrast * modulus), length, gap * length
        lines = [
            [np.linspace(0, 1, m + 1), low + np.linspace(0, 0.5, m // 2 + 1)]
            for m, low in zip(n, (0.0, 0.5 + MESHING_GAP), strict=True)
        ]
        sides = {
            BOTTOM: at_coordinate(1, 0.0),
            TOP: at_coordinate(1, 1.0 + MESHING_GAP),
            LEFT: at_coordinate(0, 0.0),
            FRONT: at_coordinate(1, 0.5),
            OPPOSITE: at_coordinate(1, 0.5 + MESHING_GAP),
        }

        def bend(x: Array) -> Array:
            upper = x[:, 1] > 0.5 + 0.5 * MESHING_GAP
            down = np.where(upper, gap - MESHING_GAP, 0.0)
            return length * np.column_stack([x[:, 0], x[:, 1] + down])

        made = boxes(lines, sides, bend=bend, partitioner=partitioner)
        mesh = made[0]
        n_cells = mesh.topology.index_map(2).size_local + mesh.topology.index_map(2).num_ghosts
        cells = np.arange(n_cells, dtype=np.int32)
        # Midpoints of the cells; the lower block ends at 1/2.
        height = dolfinx.mesh.compute_midpoints(mesh, 2, cells).reshape(-1, 3)[:, 1]
        upper = height > 0.5 * length
        self.cells = cells[~upper], cells[upper]
        stiffness = fem.Function(fem.functionspace(mesh, ("DG", 0)))
        stiffness.x.array[:] = np.where(upper, self.moduli[1], self.moduli[0])
        self.body = body = Bodies(made, stiffness, NU)
        self.u = body.u
        self.traction = body.constant(np.zeros(2))
        body.F = body.F - ufl.dot(self.traction, body.v) * body.ds(TOP)
        self.surface = fc.ContactSurface(mesh, made[1], FRONT)

    def problem(self, law: Any, *, curved: bool = False, **options: Any) -> fc.ContactProblem:
        """Create the problem with contact of the top of the lower and bottom of the upper block.

        Args:
            law: Contact law.
            curved: Whether the gap is a parabola with a radius of twice the width.
            options: Options of `ContactProblem`.
        """
        a, x = self.length, self.body.x
        obstacle = fc.DeformableBody(self.body.tags, OPPOSITE)
        gap = (x[0] - 0.5 * a) ** 2 / (4.0 * a) if curved else None
        contact = fc.Contact(self.u, self.surface, obstacle, law, gap=gap)
        return fc.ContactProblem(
            self.body.F, self.u, bcs=self.body.bcs, contacts=[contact], **options
        )

    def press(self) -> float:
        """Apply symmetry conditions; apply and return a pressure of 1e-3 of the smaller modulus."""
        self.body.prescribe(BOTTOM, 1)
        self.body.prescribe(LEFT, 0)
        pressure = PRESSURE / E * min(self.moduli)
        self.traction.value[1] = -pressure
        return pressure

    def drag(self, down: float = 0.03, sideways: float = 0.02) -> None:
        """Clamp the bottom, and move the top down and sideways."""
        self.body.prescribe(BOTTOM, 0, 1)
        self.body.prescribe(TOP, 0, value=sideways * self.length)
        self.body.prescribe(TOP, 1, value=-down * self.length)

    def compression_error(self, k_n: float, pressure: float) -> float:
        """Return the relative error of the displacement under uniform pressure, as in `Block`."""
        exact = fem.Function(self.u.function_space)
        half = 0.5 * self.length
        lower, upper = (strains(pressure / modulus, NU, 2) for modulus in self.moduli)
        sunk = lower[0] * half + self.gap + pressure / k_n

        def below(x: Array) -> Array:
            return np.vstack([lower[1] * x[0], -lower[0] * x[1]])

        def above(x: Array) -> Array:
            return np.vstack([upper[1] * x[0], -sunk - upper[0] * (x[1] - half - self.gap)])

        for values, cells in zip((below, above), self.cells, strict=True):
            exact.interpolate(values, cells)
        exact.x.scatter_forward()
        return difference(self.u, exact)


def flat_pair(kappa: float, **pair: Any) -> Solve:
    """Press one block on the other by a uniform load; k_n is relative to the softer block."""

    def solve(method: str) -> tuple[list[fc.Step], float]:
        both = Pair(**pair)
        k_n = kappa * min(both.moduli) * 6 / both.length
        pressure = both.press()
        step = both.problem(fc.Frictionless(k_n), method=method).solve()
        return [step], both.compression_error(k_n, pressure)

    return solve


def rounded_pair(kappa: float, mu: float, **pair: Any) -> Solve:
    """Press rounded blocks and move them sideways; compare with method `alternating`."""

    def state(method: str, **options: Any) -> tuple[list[fc.Step], Pair]:
        both = Pair(**pair)
        both.drag()
        k = kappa * min(both.moduli) * 6 / both.length
        problem = both.problem(friction_law(mu, k), curved=True, method=method, **options)
        return [problem.solve()], both

    return compare_displacements(state, lambda: state("alternating", fallback=False))


def solve_pair_in_units(method: str, modulus: float, length: float, _: Any) -> State:
    """Solve the rounded blocks; return the step, and u divided by the length."""
    both = Pair(modulus=modulus, length=length)
    both.drag()
    step = both.problem(fc.Coulomb(0.3), curved=True, method=method).solve()
    return step, both.u.x.array / length


# ---- Hertz ---------------------------------------------------------------------------------------


def hertz(kappa: float, *, enforcement: str = "penalty") -> tuple[Solve, float]:
    """Press a rigid cylinder on a half-plane; return the problem and the error due to the penalty.

    The penetration p₀/k_n relative to the approach a²/2R of the half-plane is ε = E*/(k_n a), as
    p₀ = E* a/2R: Hertz's peak pressure changes by at most ε. For ε > 1 the contact is an elastic
    foundation with P = 2/3 k_n a³/R and p₀ = k_n a²/2R, which changes by at most 1/ε with its own
    contact half-width a.
    """
    star, radius, a = E / (1 - NU**2), 8.0, 0.1
    force = np.pi * a**2 * star / (4 * radius)
    peak, cells, far = star * a / (2 * radius), 10, 40.0
    h = a / cells
    k_n = kappa * E / h
    penalty_error = star / (k_n * a)
    if penalty_error > 1 and enforcement == "penalty":
        a = (1.5 * force * radius / k_n) ** (1 / 3)
        peak, penalty_error = k_n * a**2 / (2 * radius), k_n * a / star
    if enforcement != "penalty":
        penalty_error = 0.0

    def solve(method: str) -> tuple[list[fc.Step], float]:
        x = graded(0.15, 15, far * 0.1, 1.3)
        y = -graded(0.15, 15, far * 0.1, 1.3)[::-1]
        sides = {
            BOTTOM: at_coordinate(1, y[0]),
            LEFT: at_coordinate(0, 0.0),
            FRONT: at_coordinate(1, 0.0),
        }
        body = Bodies(boxes([[x, y]], sides), E, NU, degree=2)
        body.prescribe(BOTTOM, 0, 1)
        body.prescribe(LEFT, 0)
        cylinder = fc.Motion(force=(None, -force / 2))
        gap = body.x[0] ** 2 / (2 * radius)
        obstacle = fc.PrescribedGap(gap, (0.0, 1.0), displacement=cylinder)
        law = fc.Frictionless(k_n)
        contact = body.contact(FRONT, obstacle, law, enforcement=enforcement)
        problem = body.problem(contact, method=method)
        step = problem.solve()
        return [step], abs(step.contacts["contact"].max_pressure / peak - 1)

    return solve, penalty_error


# ---- several ranks -------------------------------------------------------------------------------


def partition_blocks(comm: MPI.Comm, n_parts: int, cell_types: Any, cells: Any) -> Any:
    """Partition `Pair`: the lower block on the last rank, the upper one on the others."""
    n_cells = cells[0].size // 4
    n_lower = 6 * 3
    upper = np.arange(max(n_cells - n_lower, 0)) * (n_parts - 1) // max(n_cells - n_lower, 1)
    return partition_from_owners(
        np.concatenate([np.full(min(n_lower, n_cells), n_parts - 1), upper])
    )


def solve_on_ranks(
    kind: str, kappa: float, mu: float, method: str, *, separate_ranks: bool = True
) -> tuple[fc.Step, Array, list[int]]:
    """Solve two blocks, or one block on a disc, with Γc on the last rank if ``separate_ranks``.

    Collective.

    Returns:
        The step; coordinates and displacements of all nodes (n_nodes, 4), sorted; and the number
        of facets of Γc on every rank.
    """
    comm = MPI.COMM_WORLD
    both = Pair(
        gap=1e-3, partitioner=partition_blocks if separate_ranks and comm.size > 1 else None
    )
    both.drag()
    law = friction_law(mu, kappa * 6 * E)
    if kind == "two bodies":
        problem = both.problem(law, method=method)
    else:  # the upper block is unloaded and fixed
        both.body.bcs.clear()
        both.body.prescribe(OPPOSITE, 0, 1)
        both.body.prescribe(BOTTOM, 0, value=0.02)
        both.body.prescribe(BOTTOM, 1, value=0.03)
        obstacle = fc.Ball((0.5, 2.5), 2.0)
        contact = fc.Contact(both.u, both.surface, obstacle, law)
        problem = fc.ContactProblem(
            both.body.F, both.u, bcs=both.body.bcs, contacts=[contact], method=method
        )
    step = problem.solve()
    space = both.u.function_space
    n = space.dofmap.index_map.size_local
    x, u = space.tabulate_dof_coordinates()[:n, :2], both.u.x.array.reshape(-1, 2)[:n]
    rows = np.concatenate(comm.allgather(np.column_stack([x, u])))
    order = np.lexsort(np.round(rows[:, :2], 9).T)
    return step, rows[order], comm.allgather(len(both.surface.facets))


def compare_with_one_rank(ranks: int, kind: str, kappa: float, mu: float) -> Solve:
    """Run `solve_on_ranks` on several ranks; compare the displacements with those on one rank."""

    def solve(method: str) -> tuple[list[fc.Step], float]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "state"
            words = command(ranks, __file__, kind, kappa, mu, method, path)
            done = subprocess.run(
                words, env=subprocess_environment(), capture_output=True, timeout=120
            )
            if done.returncode:
                raise RuntimeError(done.stderr.decode(errors="replace")[-300:])
            step, rows, n_facets = pickle.loads(path.read_bytes())
        if np.count_nonzero(n_facets) != 1:
            raise RuntimeError(f"Γc is not on one rank alone: {n_facets} facets")
        _, alone, _ = solve_on_ranks(kind, kappa, mu, method)
        return [step], float(np.abs(rows - alone).max() / np.abs(alone[:, 2:]).max())

    return solve


if __name__ == "__main__":
    kind, kappa, mu, method, path = sys.argv[1:]
    found = solve_on_ranks(kind, float(kappa), float(mu), method)
    if MPI.COMM_WORLD.rank == 0:
        Path(path).write_bytes(pickle.dumps(found))
