"""Contact of two bodies with a mixed displacement-pressure formulation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean
from scenes.comparison import (
    assemble_owned,
    compile_with_maps,
    is_close,
    owned_values,
    shared_folder,
)
from scenes.elasticity import strain
from scenes.rubber import MIXED, TIGHT_TOLERANCE, mixed_space, split
from scenes.tags import plane, tag_by_nodes
from scenes.two_blocks import BOTTOM, LOWER_FACE, TOP, UPPER_FACE, two_blocks

pytestmark = [
    pytest.mark.newest,
    pytest.mark.two_ranks,
    pytest.mark.timeout(300),
]
E = 1000.0
G = E / 3  # ν = 1/2


class Blocks:
    """Two blocks of incompressible rubber in plane strain, 1 by 1/2 each, one on the other."""

    def __init__(
        self,
        kinematics: str,
        law: fc.Law,
        *,
        mixed: str = "Taylor-Hood",
        smooth: bool = False,
        n: tuple[int, int] = (4, 4),
        widths: tuple[float, float] = (1.0, 1.0),
        shift: float = 0.0,
        contact: dict[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Create meshes, forms and problem. Collective.

        Args:
            kinematics: "finite" with a neo-Hookean bulk, or "small" with a linear one.
            law: Contact law between the blocks.
            mixed: Name of the elements, one of `MIXED`.
            smooth: Whether bottom, top and left sides slide on planes; otherwise bottom and top
                are prescribed in both directions, and the top moves sideways.
            n: Numbers of cells along the sides of the lower and the upper block.
            widths: Widths of the lower and the upper block.
            shift: Initial sideways position of the upper block.
            contact: Further arguments of the `Contact`.
            **options: Arguments of the `ContactProblem`.
        """
        mesh, tags = two_blocks("triangle", n, widths, shift)
        self.mesh, W = mesh, mixed_space(mesh, mixed)
        self.w = fem.Function(W)
        (u, p), (v, q) = split(ufl.split(self.w)), split(ufl.TestFunctions(W))
        if kinematics == "finite":
            dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
            self.F = NeoHookean(u, E, 0.5, "plane strain", pressure=p).residual(v, dx, q=q)
        else:
            work = 2 * G * ufl.inner(strain(u), strain(v)) - p * ufl.div(v) - q * ufl.div(u)
            self.F = work * ufl.dx(mesh)
        self.form = compile_with_maps(self.F)
        self.along, self.down = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
        nothing = fem.Constant(mesh, 0.0)
        left = tag_by_nodes(mesh, {9: plane(0, 0.0)})
        conditions = [(tags, BOTTOM, 1, nothing), (tags, TOP, 1, self.down)]
        if smooth:
            conditions += [(left, 9, 0, nothing)]
        else:
            conditions += [(tags, BOTTOM, 0, nothing), (tags, TOP, 0, self.along)]
        bcs = []
        for where, tag, i, value in conditions:
            part = W.sub(0).sub(i)
            dofs = fem.locate_dofs_topological(part, 1, where.find(tag))
            bcs.append(fem.dirichletbc(value, dofs, part))
        self.contact = fc.Contact(
            u,
            fc.ContactSurface(mesh, tags, UPPER_FACE),
            fc.DeformableBody(tags, LOWER_FACE, update_pairs="never"),
            law,
            kinematics=kinematics,
            **(contact or {}),
        )
        options = {"petsc_options": TIGHT_TOLERANCE} | options
        if kinematics == "small":  # for comparison with closed forms
            options["small_displacement_tolerance"] = np.inf
        self.problem = fc.ContactProblem(
            self.F, self.w, bcs=bcs, contacts=[self.contact], **options
        )

    def load(self, t: float) -> None:
        """Move the top down in the first half, then sideways."""
        self.down.value = -0.06 * min(1.0, 2 * t)
        self.along.value = 0.2 * max(0.0, 2 * t - 1)

    def reaction(self, height: float) -> np.ndarray:
        """Assemble the reaction of the nodes at a height, (2,). Collective."""
        forces = assemble_owned(self.form, self.w.function_space)
        part = self.problem.displacement
        computed = np.zeros(2)
        for i in range(2):
            chosen = fem.Function(part.u.function_space)
            at_height = np.isclose(part.u.function_space.tabulate_dof_coordinates()[:, 1], height)
            chosen.x.array[i::2] = at_height
            computed[i] = self.mesh.comm.allreduce(part.within(owned_values(chosen)) @ forces)
        return computed


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize("mixed", MIXED)
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_uniform_compression(kinematics, mixed, enforcement):
    """Between frictionless planes the nominal stress is G (λ - λ⁻³), or linear 4 G ε, to 1e-6.

    Plane strain with ν = 1/2, free on the right. Both blocks widen equally, so that no point slips.
    The penalty adds a penetration p/k_n; multipliers leave 1e-9 of that.
    """
    down, k_n = 0.2 if kinematics == "finite" else 0.01, 1e6
    nominal = 0.0
    for _ in range(30):  # fixed-point iteration for the penetration
        stretch = 1 - down - (nominal / k_n if enforcement == "penalty" else 0.0)
        nominal = 4 * G * (stretch - 1) if kinematics == "small" else G * (stretch - stretch**-3)
    options = {"enforcement": enforcement}
    if enforcement == "augmented":
        options["tolerance"] = 1e-9
    setup = Blocks(
        kinematics,
        fc.Coulomb(0.3, k_n, k_n),
        mixed=mixed,
        smooth=True,
        contact=options,
    )
    for factor in (0.5, 1.0):
        setup.down.value = -factor * down
        step = setup.problem.solve()
        setup.problem.commit()
    force = step.contacts["contact"]
    assert force.normal_force == pytest.approx(-nominal, rel=1e-6)
    assert force.slip == 0 and force.tangential_force < 1e-6 * force.normal_force
    assert is_close(setup.contact.pressure, np.full_like(setup.contact.pressure, -nominal), 1e-6)


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_dragged_block_slips_at_the_friction_bound(kinematics, enforcement):
    """A narrow block is pressed on a wide one and dragged until it slips with the force μ N.

    That, and the balance of the contact force and the assembled reactions of bottom and top, holds
    to 1e-9.
    """
    setup = Blocks(
        kinematics,
        fc.Coulomb(0.3),
        n=(8, 4),
        widths=(2.0, 1.0),
        shift=0.25,
        contact={"enforcement": enforcement},
    )
    for step in fc.increments(setup.problem, setup.load, 0, 1, steps=8):
        assert not step.verdict.failures
        force = step.contacts["contact"].force
        assert is_close(setup.reaction(1.0), -force, 1e-9)
        assert is_close(setup.reaction(0.0), force, 1e-9)
    last = step.contacts["contact"]
    assert last.slip > 0 and last.stick == 0
    assert force[0] < 0 < force[1]
    assert last.tangential_force == pytest.approx(0.3 * last.normal_force, rel=1e-9)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_restarted_history_gives_the_same_solution(kinematics, tmp_path):
    """A restart while the block is dragged gives the same force and displacement to 1e-9."""

    def make() -> Blocks:
        wide = {"n": (8, 4), "widths": (2.0, 1.0), "shift": 0.25}
        return Blocks(kinematics, fc.Coulomb(0.3), **wide)

    folder = shared_folder(tmp_path)
    uninterrupted, first, second = make(), make(), make()
    for _ in fc.increments(uninterrupted.problem, uninterrupted.load, 0, 1, steps=8):
        pass
    file = folder / "state.npz"
    for step in fc.increments(first.problem, first.load, 0, 1, steps=8, checkpoint=file):
        if step.increment == 6:
            break
    for _ in fc.increments(second.problem, second.load, 0, 1, steps=8, checkpoint=file):
        pass
    forces = [each.contact.resultants().force for each in (uninterrupted, second)]
    assert is_close(forces[1], forces[0], 1e-9)
    assert is_close(owned_values(second.w), owned_values(uninterrupted.w), 1e-9)
