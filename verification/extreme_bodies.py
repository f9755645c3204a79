"""Problems with extreme parameters: finite sliding of two deformable bodies.

As in `extreme_scenes` a problem is a function of the method that returns the steps and the relative
error. A rubber block is on another one; if not stated otherwise, the bottom of the lower block is
fixed, and the top of the upper block is moved.
"""

from __future__ import annotations

from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.elasticity import NeoHookean
from scenes.bodies import boxes
from scenes.comparison import point_values
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.rubber import TIGHT_TOLERANCE, rubber
from scenes.tags import any_of, at_coordinate, at_interface
from verification import sliding_reference, sliding_scenes
from verification.extreme_finite import (
    NU,
    E,
    bisect,
    compare_with_independent_solver,
    nominal,
    relative_error,
    stress,
)
from verification.extreme_scenes import Array, Solve, friction_law
from verification.sliding_scenes import rotation_matrix

BOTTOM, TOP, LOWER, UPPER, LEFT, RIGHT = 1, 2, 3, 4, 5, 6
APPROACH = 0.1  # approach of the blocks


class TwoBlocks:
    """Two rubber blocks in plane strain, each of height 1.

    Attributes:
        u, contact, problem: Displacement, contact and problem.
        position: Lateral and downward displacement of the top, and rotation of both ends (rad).
        pressure: Pressure on the top.
    """

    def __init__(
        self,
        method: str,
        *,
        kappa: float = 10.0,
        mu: float = 0.0,
        widths: tuple[float, float] = (2.0, 1.0),
        start: float = 0.5,
        n: tuple[int, int] = (8, 6),
        rows: int = 4,
        moduli: tuple[float, float] = (E, E),
        slave_tag: int = UPPER,
        edge_gap: float = 0.0,
        gap: float = 0.0,
        ends: str = "prescribed",
        points: int | None = None,
    ) -> None:
        """Create the unloaded blocks. Collective.

        Args:
            method: Method of the problem.
            kappa: Contact stiffness in units of the smaller modulus over the cell height.
            mu: Friction coefficient.
            widths: Widths of the lower and upper block.
            start: Left end of the upper block.
            n: Numbers of cells along the widths.
            rows: Number of cells over the height of each block.
            moduli: Young's moduli.
            slave_tag: Tag of Γc, `LOWER` or `UPPER`.
            edge_gap: Gap at the ends due to the curvature of the upper block.
            gap: Initial gap.
            ends: "prescribed": all displacements of bottom and top are prescribed; "frictionless":
                vertical ones, and symmetry at the left sides; "confined": symmetry at the right
                sides, too; "force": bottom fixed, top fixed horizontally.
            points: Quadrature points per facet of Γc.
        """
        lefts = (0.0, start)
        lines = [
            [np.linspace(left, left + width, m + 1), np.linspace(low, low + 1.0, rows + 1)]
            for left, width, m, low in zip(lefts, widths, n, (0.0, 1.0), strict=True)
        ]
        sides = {LEFT: any_of(*(at_coordinate(0, left) for left in lefts))}
        sides[RIGHT] = any_of(
            *(at_coordinate(0, a + b) for a, b in zip(lefts, widths, strict=True))
        )
        sides |= {BOTTOM: at_coordinate(1, 0.0), TOP: at_coordinate(1, 2.0)}
        sides |= {LOWER: at_interface(1, 1.0, above=False), UPPER: at_interface(1, 1.0, above=True)}
        mesh, tags = boxes(lines, sides)
        cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
        upper = dolfinx.mesh.compute_midpoints(mesh, 2, cells)[:, 1] > 1.0
        x, lifted = mesh.geometry.x, np.unique(compat.geometry_dofmap(mesh)[upper])
        away = 2 * (x[lifted, 0] - start) / widths[1] - 1
        x[lifted, 1] += gap + edge_gap * away**2 * (2.0 - x[lifted, 1])
        modulus = fem.Function(fem.functionspace(mesh, ("DG", 0)))
        modulus.x.array[:] = np.where(upper, moduli[1], moduli[0])
        self.u = u = fem.Function(displacement_space(mesh, 1))
        V, v = u.function_space, ufl.TestFunction(u.function_space)
        self.position, self.pressure = np.zeros(3), fem.Constant(mesh, 0.0)
        self._top, self._prescribed = [fem.Constant(mesh, 0.0) for _ in range(2)], []
        if ends == "prescribed":
            for tag in (BOTTOM, TOP):
                dofs = fem.locate_dofs_topological(V, 1, tags.find(tag))
                self._prescribed.append(fem.dirichletbc(fem.Function(V), dofs))
        bcs = list(self._prescribed)
        if ends == "force":
            bcs = [dirichlet_bc(u, tags, BOTTOM, i) for i in range(2)] + [
                dirichlet_bc(u, tags, TOP, 0)
            ]
        elif ends != "prescribed":
            bcs = [dirichlet_bc(u, tags, BOTTOM, 1), dirichlet_bc(u, tags, TOP, 1, self._top[1])]
            bcs += [
                dirichlet_bc(u, tags, side, 0) for side in (LEFT, RIGHT)[: 1 + (ends == "confined")]
            ]
        body = NeoHookean(u, modulus, NU, "plane strain")
        ds = ufl.ds(mesh, subdomain_data=tags)
        F = body.residual(v) + self.pressure * v[1] * ds(TOP)
        degree = None if points is None else 2 * points - 1
        self.contact = fc.Contact(
            u,
            fc.ContactSurface(mesh, tags, slave_tag, quadrature_degree=degree),
            fc.DeformableBody(tags, LOWER if slave_tag == UPPER else UPPER),
            friction_law(mu, kappa * min(moduli) * rows),
            kinematics="finite",
        )
        self.problem = fc.ContactProblem(
            F, u, bcs=bcs, contacts=[self.contact], method=method, petsc_options=TIGHT_TOLERANCE
        )

    @property
    def force(self) -> Array:
        """Contact force on the body with Γc, (2,)."""
        return self.contact.resultants().force

    def set_position(self, sideways: float, down: float, angle: float) -> None:
        """Set the displacement of the top, and the rotation of bottom and top about the origin."""
        self._top[1].value = -down
        for bc, offset in zip(self._prescribed, ((0.0, 0.0), (sideways, -down)), strict=False):
            x = self.u.function_space.tabulate_dof_coordinates()[:, :2]
            bc.g.x.array[:] = ((x + offset) @ rotation_matrix(2, angle).T - x).ravel()

    def move_to(
        self, sideways: float, down: float, steps: int, angle: float = 0.0, **options: Any
    ) -> list[fc.Step]:
        """Move the blocks in equal increments to a displacement and an angle. Collective."""
        start, end = self.position, np.array([sideways, down, angle])

        def load(t: float) -> None:
            self.set_position(*(start + t * (end - start)))

        made = list(fc.increments(self.problem, load, steps=steps, **options))
        self.position = end
        return made


# ---- rotation and sliding ------------------------------------------------------------------------


def rotate_together(steps: int, mu: float = 0.3, angle: float = 2 * np.pi, **two: Any) -> Solve:
    """Press and slide, then rotate both blocks; reference: the rotated tractions."""

    def solve(method: str) -> tuple[list[fc.Step], float]:
        both = TwoBlocks(method, mu=mu, edge_gap=0.1, **two)
        made = both.move_to(0.0, APPROACH, 2) + both.move_to(0.05, APPROACH, 2)
        before = point_values(both.contact, both.contact.traction)
        made += both.move_to(0.05, APPROACH, steps, angle)
        now = point_values(both.contact, both.contact.traction)
        return made, relative_error(now, before @ rotation_matrix(2, angle).T)

    return solve


def slide_over_facets(n: int, steps: int, mu: float, n_upper: int = 50) -> Solve:
    """Slide along a block of n facets, over more than half of them.

    Reference: the force at a tenth of the path, a whole number of facets before. The ends of the
    long block are more than 4 heights away, which changes the force by less than 1e-4.

    Args:
        n: Number of facets of the lower block, whose length is 20.
        steps: Number of increments.
        mu: Friction coefficient.
        n_upper: Number of facets of the upper block, whose length is 1.
    """

    def solve(method: str) -> tuple[list[fc.Step], float]:
        both = TwoBlocks(method, mu=mu, widths=(20.0, 1.0), start=4.0, n=(n, n_upper), rows=2)
        made = both.move_to(0.0, APPROACH, 2)
        made += both.move_to(1.1, APPROACH, max(1, steps // 10))
        first = both.force
        made += both.move_to(11.0, APPROACH, steps)
        return made, relative_error(both.force, first)

    return solve


def slide_off(mu: float, steps: int, **two: Any) -> Solve:
    """Slide off the end of the lower block.

    Reference: zero force; without friction also the initial force after return.
    """

    def solve(method: str) -> tuple[list[fc.Step], float]:
        both = TwoBlocks(method, mu=mu, **two)
        made = both.move_to(0.0, 0.5 * APPROACH, 1)
        first = both.force
        made += both.move_to(2.0, 0.5 * APPROACH, steps, max_cuts=6)
        off = float(np.abs(both.force).max() / np.abs(first).max())
        if mu:
            return made, off
        made += both.move_to(0.0, 0.5 * APPROACH, steps, max_cuts=6)
        return made, max(relative_error(both.force, first), off)

    return solve


def lift_off(mu: float, **two: Any) -> Solve:
    """Press, slide and lift off; reference: zero force, and rigid-body displacements."""

    def solve(method: str) -> tuple[list[fc.Step], float]:
        both = TwoBlocks(method, mu=mu, edge_gap=0.1, gap=1e-3, **two)
        made = both.move_to(0.0, APPROACH, 2) + both.move_to(0.2, APPROACH, 4)
        first = np.abs(both.force).max()
        made += both.move_to(0.3, -0.2, 4)
        upper = both.u.function_space.tabulate_dof_coordinates()[:, 1] > 1.0 + 1e-4
        rigid = np.where(upper[:, None], (0.3, 0.2), (0.0, 0.0))
        bent = np.abs(both.u.x.array.reshape(-1, 2) - rigid).max()
        return made, max(float(np.abs(both.force).max() / first), float(bent))

    return solve


# ---- strain, stiffness, first contact ------------------------------------------------------------


def column(
    kappa: float,
    stretch: float = 0.6,
    steps: int = 1,
    *,
    gap: float = 0.0,
    mu: float = 0.0,
    cuts: int = 6,
    **two: Any,
) -> Solve:
    """Compress two blocks of equal width to a fraction of their height.

    Stretches are uniform: the pressure is determined by bisection and compared at every point of
    Γc. Blocks of equal modulus have free sides, others are confined.
    """

    def solve(method: str) -> tuple[list[fc.Step], float]:
        moduli = two.get("moduli", (E, E))
        ends = "frictionless" if moduli[0] == moduli[1] else "confined"
        options = {"n": (4, 4)} | two
        both = TwoBlocks(
            method, kappa=kappa, mu=mu, widths=(1.0, 1.0), start=0.0, gap=gap, ends=ends, **options
        )
        down = gap + 2.0 * (1.0 - stretch)
        made = both.move_to(0.0, down, steps, max_cuts=cuts)
        k_n = kappa * min(moduli) * options.get("rows", 4)

        def axial_stress(along: float) -> float:
            return stress(along) if ends == "frictionless" else nominal(along, 1.0)[0]

        def height(p: float, modulus: float) -> float:
            return bisect(lambda s: modulus / E * axial_stress(s) + p, 1e-3, 1.0)

        def lacking(p: float) -> float:
            return p / k_n - sum(height(p, modulus) for modulus in moduli) + 2.0 * stretch

        wanted = bisect(lacking, 0.0, 1e3 * min(moduli))
        return made, relative_error(both.contact.pressure, wanted)

    return solve


def against_solver(
    kappa: float,
    mu: float,
    bulk: str = "rubber",
    *,
    n: tuple[int, int] = (4, 3),
    moduli: tuple[float, float] = (E, E),
    slave_tag: int = UPPER,
    steps: int = 2,
) -> Solve:
    """Press a block on another one, slide and rotate it; compare with the independent solver."""
    soft = min(moduli) / moduli[0 if slave_tag == LOWER else 1]
    law: dict[str, Any] = {"kind": "coulomb" if mu else "frictionless"}
    law |= {"k_n": ["number", 4 * kappa * soft]}
    law |= {"k_t": ["number", 4 * kappa * soft], "friction": mu} if mu else {}
    upper, lower = {"body": 1, "side": "bottom"}, {"body": 0, "side": "top"}
    here, there = (upper, lower) if slave_tag == UPPER else (lower, upper)
    obstacle = {"kind": "body", "update_pairs": "never"} | there
    slab = {"origin": [0.0, 0.0], "size": [2.0, 1.0], "n": [n[0], 2], "E": moduli[0], "jitter": 0}
    block = {"origin": [0.6, 1.0], "size": [0.8, 0.5], "n": [n[1], 2], "E": moduli[1], "jitter": 0}
    still = {"normal": 1.0, "across": 0.0, "spin": 0.0, "steps": steps}
    scene = {"kinematics": "finite sliding", "bulk": bulk, "layout": "two", "cell": "quadrilateral"}
    scene |= {"degree": 1, "nu": NU, "bodies": [slab, block], "units": [1.0, 1.0]}
    scene |= {"drive": "prescribed", "contacts": [here | {"obstacle": obstacle, "law": law}]}
    scene |= {"dirichlet": [[0, "bottom", [0, 1], "fixed"], [1, "top", [0, 1], "moved"]]}
    scene |= {"strain": 0.1, "load_ratio": 1.0, "bend": [0.0, 0.1]}
    scene |= {"stages": [still | {"side": 0.0, "turn": 0.0}, still | {"side": 0.1, "turn": 0.05}]}
    return compare_with_independent_solver(
        scene, sliding_scenes.SlidingSetup, sliding_reference.make_problem
    )


def stiff_plate(ratio: float, mu: float, n: tuple[int, int] = (8, 4), kappa: float = 10.0) -> Solve:
    """Press and slide a block under a plate of ``ratio`` times its modulus.

    Reference: forces of a rigid plane, with the same quadrature points on Γc.
    """

    def rigid(method: str, points: int) -> Array:
        block = rubber("quadrilateral", 1, n=(n[0], 4), size=(1.0, 1.0), E=E, nu=NU)
        shift = fem.Constant(block.mesh, np.zeros(2))
        plate = fc.HalfSpace((0.0, 1.0), (0.0, -1.0), displacement=shift)
        law = friction_law(mu, kappa * E * 4)
        options = {"contact": {"points_degree": 2 * points - 1}, "petsc_options": TIGHT_TOLERANCE}
        problem, contact = block.problem(plate, law, method=method, **options)
        found = []
        for t in range(1, 5):
            shift.value[:] = 0.05 * max(t - 2, 0), -0.5 * APPROACH * min(t, 2)
            problem.solve()
            problem.commit()
            found.append(contact.resultants().force)
        return np.array(found)

    def solve(method: str) -> tuple[list[fc.Step], float]:
        two = {"widths": (1.0, 2.0), "start": -0.5, "n": n, "moduli": (E, ratio * E)}
        both = TwoBlocks(method, kappa=kappa, mu=mu, slave_tag=LOWER, **two)
        made, found = [], []
        for t in range(1, 5):
            made += both.move_to(0.05 * max(t - 2, 0), 0.5 * APPROACH * min(t, 2), 1)
            found.append(both.force)
        points = both.contact.quadrature.n_points // n[0]  # on one rank
        return made, relative_error(found, rigid(method, points))

    return solve


def close_gap(gap: float, by_force: bool = False, **two: Any) -> Solve:
    """Close a gap in one increment; reference: the force without the gap, or the load."""

    def force(method: str, gap: float) -> tuple[list[fc.Step], float]:
        options = {"ends": "force"} if by_force else {"edge_gap": 0.1}
        both = TwoBlocks(method, gap=gap, **options, **two)
        if not by_force:
            return both.move_to(0.0, gap + APPROACH, 1, max_cuts=10), both.force[1]
        made = list(fc.increments(both.problem, both.pressure, 0.0, 60.0, steps=1, max_cuts=10))
        return made, both.force[1]

    def solve(method: str) -> tuple[list[fc.Step], float]:
        made, found = force(method, gap)
        return made, relative_error(found, 60.0 if by_force else force(method, 0.0)[1])

    return solve


def indent(steps: int, **two: Any) -> Solve:
    """Press without friction in any number of increments; reference: 16 increments."""

    def force(method: str, steps: int) -> tuple[list[fc.Step], Array]:
        both = TwoBlocks(method, edge_gap=0.1, **two)
        return both.move_to(0.0, 0.3, steps), both.force

    def solve(method: str) -> tuple[list[fc.Step], float]:
        made, found = force(method, steps)
        return made, relative_error(found, force(method, 16)[1])

    return solve
