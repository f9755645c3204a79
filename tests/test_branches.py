"""Of several equilibria with friction the solution is the one that smaller increments lead to.

A wedge of half-angle atan(0.2) between walls with μ = 0.5 is self-locking: pressed in and released
it stays, and the walls still exert forces on it. In one increment the equations have another
solution, too: outside of the walls, without forces. The reference is the same history in eight
increments.
"""

import warnings

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import LEFT, RIGHT, block
from scenes.comparison import is_close

COMM = MPI.COMM_WORLD
PRESS = 10.0

pytestmark = pytest.mark.two_ranks


def wedge_between_walls(**options):
    """Make a wedge between a vertical and an inclined wall, constrained by friction alone."""
    scene = block("quadrilateral", n=6)
    x = scene.mesh.geometry.x
    x[:, 0] *= 1 + 0.2 * x[:, 1]
    contacts = [
        fc.Contact(
            scene.u,
            fc.ContactSurface(scene.mesh, scene.tags, tag),
            fc.HalfSpace(point, normal),
            fc.Coulomb(0.5),
            name=name,
        )
        for name, tag, point, normal in (
            ("upright", LEFT, (0, 0), (1, 0)),
            ("leaning", RIGHT, (1, 0), (-1, 0.2)),
        )
    ]
    problem = fc.ContactProblem(
        scene.F, scene.u, contacts=contacts, small_displacement_tolerance=np.inf, **options
    )
    return scene, problem, contacts


def release_wedge(steps, **options):
    """Press the wedge in and release it in ``steps`` increments; return normal forces and steps."""
    scene, problem, contacts = wedge_between_walls(**options)

    def load(factor):
        scene.load(up=-PRESS * factor)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        list(fc.increments(problem, load, 0.0, 1.0))
        taken = list(fc.increments(problem, load, 1.0, 0.0, steps=steps))
    return np.array([c.resultants().normal_force for c in contacts]), taken


@pytest.mark.parametrize("method", [None, "newton", "continuation"])
def test_locked_wedge_keeps_its_forces(method):
    """Released in one increment, cut when it is ejected, it has the forces of eight, within 2 %."""
    expected, steps = release_wedge(8)
    assert len(steps) == 8 and np.all(expected > 5.0)
    computed, _ = release_wedge(1, method=method)
    assert is_close(computed, expected, 0.02)


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "newton", "lbfgs"])
@pytest.mark.parametrize("pull", [0.01, 0.2])
def test_locked_wedge_without_load_is_not_taken_for_unloaded(pull, method):
    """Without load contact forces cancel, and a pull starts at the position of the locked wedge.

    The pull is far below what frees the wedge: one increment has the forces of eight, within 2 %.
    Continuation alone is excluded: it begins with soft contact, which locks nothing, and is
    refused.
    """
    forces = []
    for steps in (1, 8):
        scene, problem, contacts = wedge_between_walls(method=method)

        def load(factor, scene=scene):
            scene.load(up=-PRESS * factor)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            list(fc.increments(problem, load, 0.0, 1.0))
            list(fc.increments(problem, load, 1.0, 0.0, steps=8))
            pulled = list(fc.increments(problem, load, 0.0, -pull, steps=steps))
        assert len(pulled) == steps  # no increment was cut
        forces.append([c.resultants().normal_force for c in contacts])
    assert min(forces[1]) > 5.0
    assert is_close(np.array(forces[0]), np.array(forces[1]), 0.02)


def test_ejected_wedge_is_refused():
    """Without cuts the increment is refused with the reason, and the history is unchanged."""
    scene, problem, contacts = wedge_between_walls(method="newton")
    scene.load(up=-PRESS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        problem.solve()
        problem.commit()
        before = [c.history.rows() for c in contacts]
        scene.load()
        with pytest.raises(fc.NotConverged, match="friction supplies energy"):
            problem.solve()
    for contact, rows in zip(contacts, before, strict=True):
        assert is_close(contact.history.rows(), rows, 0.0)


def test_friction_supplies_at_most_one_percent_of_the_energy():
    """Friction dissipates in every increment of pressing, releasing and pressing again.

    If slip is reversed within an increment the mean of the tractions misses this: 1 %.
    """
    scene, problem, _ = wedge_between_walls()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for factor in (0.5, 1.0, 0.75, 0.5, 0.25, 0.0, 0.5, 1.0):
            scene.load(up=-PRESS * factor)
            step = problem.solve()
            problem.commit()
            assert step.energy.friction_energy_gain == step.verdict.friction_energy_gain <= 0.01
