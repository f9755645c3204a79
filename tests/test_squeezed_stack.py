"""Free blocks that are squeezed between two plates, sheared, released and squeezed again."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic
from scenes.blocks import BOTTOM, TOP, block_mesh
from scenes.elasticity import dirichlet_bc
from scenes.stacks import FLOOR, ROOF, joint, stack

BLOCKS, GAP, HEIGHT, PLATE = 3, 0.002, 0.4, 0.3
DEPTH = 0.01 + (BLOCKS + 1) * GAP


@pytest.mark.two_ranks
def test_squeezed_block_stays_in_the_stack() -> None:
    """The second pressing has the force of the first, 5.6, to 1 %: the stack has moved a little.

    Blocks stay within 1 % of their width, and Newton's method needs no fallback. Surfaces deformed
    by friction are slightly inclined: an initial guess along them was beside the stack.
    """
    parts, y = {"low": _block(-0.2, 0.0, 1.4, PLATE, (5, 1))}, PLATE
    for number in range(BLOCKS):
        y += GAP
        parts[str(number)] = _block(0.0, y, 1.0 - 0.1 * number, HEIGHT, (3 + number, 2))
        y += HEIGHT
    parts["up"] = _block(-0.2, y + GAP, 1.4, PLATE, (6, 1))
    joined = fc.join_meshes(parts)
    V = fem.functionspace(joined.mesh, ("Lagrange", 1, (2,)))
    u = fem.Function(V, name="displacement")
    along, down = (fem.Constant(joined.mesh, 0.0) for _ in range(2))
    bcs = [dirichlet_bc(u, joined.facets, joined.facet("low", BOTTOM), i) for i in range(2)]
    for i, value in enumerate((along, down)):
        bcs.append(dirichlet_bc(u, joined.facets, joined.facet("up", TOP), i, value))

    def touch(mine: tuple[str, int], other: tuple[str, int]) -> fc.Contact:
        surface = fc.ContactSurface(joined.mesh, joined.facets, joined.facet(*mine))
        body = fc.DeformableBody(joined.facets, joined.facet(*other))
        name = f"{mine[0]}-{other[0]}"
        return fc.Contact(u, surface, body, fc.Coulomb(0.1), kinematics="finite", name=name)

    names = ["low", *map(str, range(BLOCKS))]
    pairs = zip(names[1:], names[:-1], strict=True)
    contacts = [touch((upper, BOTTOM), (lower, TOP)) for upper, lower in pairs]
    contacts.append(touch((names[-1], TOP), ("up", BOTTOM)))
    F = LinearElastic(u, 1000.0, 0.3, "plane strain").residual(ufl.TestFunction(V))
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=contacts)

    def move(value: fem.Constant, start: float, end: float, steps: int) -> float:
        def load(t: float) -> None:
            value.value = t

        for step in fc.increments(problem, load, start, end, steps=steps):
            assert {attempt.method for attempt in step.attempts} == {"newton"}
        return contacts[0].resultants().normal_force

    first = move(down, 0.0, -DEPTH, 3)
    move(along, 0.0, 0.05, 3)
    move(down, -DEPTH, 0.01, 3)
    assert move(along, 0.05, 0.0, 2) == 0.0
    again = move(down, 0.01, -DEPTH, 3)
    assert first == pytest.approx(5.6, rel=0.01)
    assert again == pytest.approx(first, rel=0.01)
    forces = [contact.resultants().force[1] for contact in contacts]
    assert np.allclose(np.abs(forces), again, rtol=1e-3)
    assert np.abs(u.x.array[::2]).max() < 0.01


@pytest.mark.two_ranks
def test_block_beside_the_stack_is_no_solution() -> None:
    """Blocks on the middle of each other: the second pressing has the force of the first, to 3 %.

    The upper block has been dragged along by 0.05 in between, and springs back a little. The same
    vertical force acts in every joint (1e-3: friction on inclined surfaces). A block beside the
    stack, 0.91 away, was accepted as a solution without forces.
    """
    widths = (1.4, 1.0, 0.9, 0.8, 1.4)
    heights = (PLATE, HEIGHT, HEIGHT, HEIGHT, PLATE)
    bodies = stack("quadrilateral", (5, 3, 4, 5, 6), heights, widths=widths, gap=GAP, nu=0.3)
    along, down = bodies.constant(), bodies.constant()
    bodies.prescribe(FLOOR, 0, 1)
    bodies.prescribe(ROOF, 0, value=along)
    bodies.prescribe(ROOF, 1, value=down)
    law = fc.Coulomb(0.1)
    contacts = [joint(bodies, j, law, kinematics="finite") for j in range(1, BLOCKS + 2)]
    problem = bodies.problem(*contacts)

    def move(value: fem.Constant, start: float, end: float) -> list[float]:
        def load(t: float) -> None:
            value.value = t

        for _ in fc.increments(problem, load, start, end, steps=3):
            pass
        return [float(contact.resultants().force[1]) for contact in contacts]

    first = move(down, 0.0, -DEPTH)
    move(along, 0.0, 0.05)
    assert move(down, -DEPTH, 0.01) == [0.0] * len(contacts)
    move(along, 0.05, 0.0)
    again = move(down, 0.01, -DEPTH)
    assert np.allclose(again, again[0], rtol=1e-3)
    assert again == pytest.approx(first, rel=0.03)
    assert np.abs(bodies.u.x.array[::2]).max() < 0.06


def _block(x: float, y: float, width: float, height: float, n: tuple[int, int]) -> tuple:
    """Return a rectangle with its lower left corner at x, y, and its facet tags. Collective."""
    mesh, tags = block_mesh("quadrilateral", n=n, size=(width, height))
    mesh.geometry.x[:, :2] += x, y
    return mesh, None, tags
