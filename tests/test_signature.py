"""Signatures of laws and obstacles differ if and only if their code differs."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.histories.signature import signature_of_law, signature_of_obstacle
from scenes.blocks import TOP, block
from scenes.comparison import assert_raised_on_all_ranks, shared_folder
from scenes.histories import BlockOnBallHistory

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.newest]


def make_rubber_law(power=1.0, factor=1.0):
    """Return a law class with this friction bound; name and parameters are always the same."""

    @dataclass(frozen=True)
    class Rubber(fc.Coulomb):
        def friction_bound(self, kinematics, pressure, parameters):
            return factor * parameters["friction"] * pressure**power

    return Rubber


@dataclass(frozen=True)
class Fixed(fc.Law):
    """A law whose signature does not depend on code of the package."""

    k_n: float
    k_t: float

    @property
    def has_tangential(self):
        """Whether the law has tangential tractions: yes, without friction."""
        return True

    def contact_traction(self, kinematics, parameters):
        """Return the traction of springs, tangential ones only where the gap is closed."""
        n, u_t = kinematics.normal, kinematics.tangential_displacement
        closing = -kinematics.gap
        across = ufl.Identity(len(n)) - ufl.outer(n, n)
        traction = -parameters["k_t"] * ufl.dot(across, u_t) / (1 + ufl.dot(u_t, u_t))
        traction = ufl.conditional(ufl.gt(closing, 0), traction, 0 * traction)
        penetration = ufl.max_value(closing, 0)
        return fc.ContactTraction(-parameters["k_n"] * penetration, traction)

    def stored(self, kinematics, response, parameters):
        """Return an arbitrary stored energy, not used here."""
        return ufl.max_value(-kinematics.gap, 0) ** 2

    def tangential_stiffness(self, kinematics, parameters):
        """Return an arbitrary tangential stiffness, not used here."""
        return parameters["k_t"] * ufl.Identity(len(kinematics.normal))


def test_signature_is_the_same_in_every_process_and_release():
    """Signatures recorded with DOLFINx 0.9 and 0.11 do not depend on rank or earlier objects."""
    mesh = block("quadrilateral").mesh
    noted = {2: "0ac21b49b020c115", 3: "d1a42274494171b5"}
    for _ in range(1 + 7 * COMM.rank):
        ufl.indices(3)
        ufl.variable(fem.Constant(mesh, 1.0))
        for gdim, word in noted.items():
            assert signature_of_law(Fixed(1.0, 1.0), gdim, multipliers=False) == word


def test_signatures_of_laws_depend_on_their_code_only():
    """They depend on bound, polygon, dimension and multipliers, not on parameter values."""
    laws = [fc.Coulomb(0.3), fc.Coulomb(0.3, modes=4), fc.Coulomb(0.3, modes=5)]
    laws += [
        make_rubber_law()(0.3),
        make_rubber_law(power=0.9)(0.3),
        make_rubber_law(factor=1.01)(0.3),
    ]
    laws += [fc.Tresca(0.3, 1.0), fc.Tresca(0.3, 1.0, unilateral=False)]
    laws += [fc.Foundation(1.0, 1.0), fc.Foundation(1.0, 1.0, tension=False), fc.Frictionless()]
    words = [signature_of_law(law, 3, multipliers=False) for law in laws]
    # A factor and an exponent of one do not change the code.
    assert words[3] == words[0] and len(set(words)) == len(words) - 1
    assert words == [signature_of_law(law, 3, multipliers=False) for law in laws]
    assert signature_of_law(laws[0], 2, multipliers=False) != words[0]
    assert signature_of_law(laws[0], 3, multipliers=True) != words[0]
    assert signature_of_law(fc.Coulomb(0.7, 1e3, 1e2), 3, multipliers=False) == words[0]


def test_signature_of_a_deeply_nested_expression():
    """An obstacle of 3000 nested terms does not exceed Python's recursion limit."""

    def distance(x):
        expression = x[0]
        for k in range(1, 3000):
            expression = ufl.min_value(expression, x[1] + k)
        return expression

    assert len(signature_of_obstacle(fc.SignedDistance(distance), 2)) == 16


@pytest.mark.parametrize("other", [make_rubber_law(power=0.99), make_rubber_law(factor=1.001)])
def test_checkpoint_of_a_law_with_other_code_is_refused(other, tmp_path):
    """A law of the same name and parameters but other code is refused; the same code continues."""
    path, options = shared_folder(tmp_path) / "state.npz", {"friction": 0.3, "k_n": 2e4, "k_t": 1e4}
    first = BlockOnBallHistory(make_rubber_law()(**options))
    for step in first.increments(checkpoint=path):
        if step.increment == 2:
            break
    changed = BlockOnBallHistory(other(**options))
    assert_raised_on_all_ranks(
        lambda: next(changed.increments(checkpoint=path)), ValueError, "code (UFL) of the law of"
    )
    assert (
        next(BlockOnBallHistory(make_rubber_law()(**options)).increments(checkpoint=path)).increment
        == 3
    )
    expected = BlockOnBallHistory(other(**options))
    assert next(expected.increments(checkpoint=path, on_mismatch="continue")).increment == 4


def test_checkpoint_of_an_obstacle_that_differs_off_contact_is_refused(tmp_path):
    """Finite kinematics may reach positions where obstacles differ that are equal near Γc."""
    path = shared_folder(tmp_path) / "state.npz"

    def history(height):
        scene = block("quadrilateral", n=3)
        push = fem.Constant(scene.mesh, 0.0)

        def distance(x):
            return x[1] - height * ufl.max_value(x[0] - 2.0, 0.0) ** 2

        obstacle = fc.SignedDistance(distance)
        bcs = [scene.dirichlet_bc(TOP, 1, push), scene.dirichlet_bc(TOP, 0)]
        contact = {"obstacle": obstacle, "kinematics": "finite"}
        problem, _ = scene.problem(fc.Frictionless(), bcs, contact=contact)
        return fc.increments(problem, push, 0.0, -0.02, steps=2, checkpoint=path)

    next(history(0.0))
    assert_raised_on_all_ranks(
        lambda: next(history(0.1)), ValueError, "code (UFL) of the obstacle of"
    )
    assert next(history(0.0)).increment == 2
