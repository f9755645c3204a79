"""Loads that friction cannot bear: found by limit analysis, said in words, and nothing else is."""

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.methods.limit_analysis import find_overload
from scenes.blocks import LEFT, RIGHT, TOP, block
from scenes.comparing import raised_everywhere
from scenes.elasticity import hold
from scenes.rubber import rubber
from scenes.tags import plane, sides

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]

MU = 0.3
# ∫ r dA over the unit square, r from its middle: (√2 + asinh 1)/6 (polar coordinates).
LEVER = (np.sqrt(2.0) + np.arcsinh(1.0)) / 6
# An even load of size 1 along the radius turned by a right angle has this moment: ∫ r² dA.
TURNED = 1 / 6


def twisted(law, n=6, **options):
    """A cube pressed on the floor by 10, that nothing else holds, and its twisting load."""
    scene = block("hexahedron", n=n, up=-10.0)
    twist, x = fem.Constant(scene.mesh, 0.0), ufl.SpatialCoordinate(scene.mesh)
    v = ufl.TestFunction(scene.u.function_space)
    around = ufl.as_vector([0.5 - x[1], x[0] - 0.5, 0.0])
    scene.F -= twist * ufl.dot(around, v) * ufl.ds(scene.mesh, subdomain_data=scene.tags)(TOP)
    problem, contact = scene.problem(law, [], small_displacement_tolerance=np.inf, **options)
    return problem, contact, twist


def overload(problem):
    """What is found at the present state under the present load."""
    return find_overload(problem.motions, problem.full.operators, problem.full.present_load())


def test_a_twist():
    """Tresca's limit along a circle at every point: the moment is limit · ∫ r dA.

    Tolerance: 1e-2, of which half is the quadrature of r, that has a kink in the middle.
    """
    problem, _, twist = twisted(fc.Tresca(MU, 10.0, k_n=1e5, k_t=1e5))
    most = MU * 10.0 * LEVER / TURNED
    twist.value = 0.98 * most
    assert overload(problem) is None
    for share in (1.02, 3.0):
        twist.value = share * most
        found = overload(problem)
        assert found.factor == pytest.approx(share, rel=1e-2)
        assert "rotation about z" in found.describe()


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "newton", "lbfgs", "alternating", "continuation"])
def test_it_ends_soon_and_says_why(method):
    """Tresca's and Coulomb's law, by statics: below the limit solved, above it refused.

    Coulomb's pressure is not even any more where the cube is twisted; its limit is found from it.
    """
    for law in (fc.Tresca(MU, 10.0, k_n=1e5, k_t=1e5), fc.Coulomb(MU, k_n=1e5, k_t=1e5)):
        problem, contact, twist = twisted(law, n=3, method=method)
        most = MU * 10.0 * LEVER / TURNED
        problem.solve()
        problem.commit()
        twist.value = 0.9 * most
        problem.solve()
        problem.commit()
        assert contact.moment((0.5, 0.5, 0.0))[2] == pytest.approx(-0.9 * most * TURNED, rel=1e-6)
        twist.value = 1.1 * most
        failed = []

        def solve(problem=problem, failed=failed):
            try:
                problem.solve()
            except fc.NotConverged as error:
                failed.append(error)
                raise

        words = "overload: along the rotation about z", "Try a smaller load, more friction"
        raised_everywhere(solve, fc.NotConverged, *words)
        # Measured: 0 to 138, of all methods one after another; continuation tries each of three
        # stiffnesses in 25 iterations at most.
        assert failed[0].iterations < 200


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "lbfgs", "newton", "alternating", "continuation"])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_loads_that_grow_together_are_none(cell, method):
    """What pressed before says nothing: both forces grow by a hundred at once."""
    scene = block(cell, n=4, up=-0.1)
    law = fc.Coulomb(MU, k_n=1e5, k_t=1e5)
    problem, contact = scene.problem(law, [], small_displacement_tolerance=np.inf, method=method)
    problem.solve()
    problem.commit()
    scene.load(up=-10.0, side=0.9 * MU * 10.0)
    problem.solve()
    found = contact.resultants()
    assert found.force[0] == pytest.approx(-0.9 * MU * 10.0, rel=1e-6)
    assert found.normal_force == pytest.approx(10.0, rel=1e-6)


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "lbfgs", "newton", "alternating", "continuation"])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
@pytest.mark.parametrize("by", ["top", "gap"])
def test_a_tight_fit_is_none(by, cell, method):
    """Squeezed by given displacements and pushed at once: soft contact could not bear it.

    Contact that is softened on the way has less pressure, and less friction, than there is. A
    column of stiffness E / h on the contact's k_n, both of area 1: N = δ / (h / E + 1 / k_n).
    """
    modulus, stiffness, depth = 1000.0, 1e5, 1e-3
    scene = block(cell, E=modulus, nu=0.0, n=4)
    pressed = scene.hold(TOP, scene.mesh.geometry.dim - 1, -depth if by == "top" else 0.0)
    law, contact = fc.Coulomb(MU, k_n=stiffness, k_t=stiffness), {}
    if by == "gap":
        contact["gap"] = -depth
    problem, contact = scene.problem(
        law, [pressed], contact=contact, small_displacement_tolerance=np.inf, method=method
    )
    force = depth / (1 / modulus + 1 / stiffness)
    scene.load(side=0.8 * MU * force)
    problem.solve()
    found = contact.resultants()
    assert found.force[0] == pytest.approx(-0.8 * MU * force, rel=1e-6)
    assert found.normal_force == pytest.approx(force, rel=1e-6)


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "lbfgs", "newton", "alternating", "continuation"])
@pytest.mark.parametrize("stiffness", [1e1, 1e3])
@pytest.mark.parametrize("share", [0.7, 0.8, 0.97])
@pytest.mark.parametrize("by", ["top", "gap"])
def test_a_tight_fit_held_by_soft_multipliers_is_none(by, share, stiffness, method):
    """The springs of the first round alone would not bear the push; multipliers do.

    Nothing gives but the column, of stiffness E / h: N = δ E / h. Springs may still bear a share of
    N as large as the tolerance, so that N misses E / (h k) times that, and the solution another.
    """
    modulus, depth, tolerance = 1000.0, 1e-3, 1e-6
    scene = block("quadrilateral", E=modulus, nu=0.0, n=4)
    pressed = scene.hold(TOP, 1, -depth if by == "top" else 0.0)
    contact = {"enforcement": "augmented", "tolerance": tolerance}
    if by == "gap":
        contact["gap"] = -depth
    problem, contact = scene.problem(
        fc.Coulomb(MU, k_n=stiffness, k_t=stiffness),
        [pressed],
        contact=contact,
        small_displacement_tolerance=np.inf,
        method=method,
    )
    force = depth * modulus
    scene.load(side=share * MU * force)
    problem.solve()
    found = contact.resultants()
    assert found.force[0] == pytest.approx(-share * MU * force, rel=10 * tolerance)
    assert found.normal_force == pytest.approx(force, rel=(1 + modulus / stiffness) * tolerance)


# Body forces on an area of 2, and what the error must say of their resultant and of the contact.
NOT_HELD = {
    "falls": ((0.0, -1.0), "translation along y) is -2, of which contact can balance at most 0 "),
    "pushed": ((2.0, 5.0), "translation along x) is 4, of which contact can balance at most 3 "),
}


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("what", NOT_HELD)
def test_rubber_that_nothing_holds_any_more(what, kinematics):
    """Pressed against a ceiling by a body force of 5, then let fall, or pushed by too much.

    The error names the motion, the load along it, and the largest contact force along it, by
    statics: 0 or μ N = 0.3 · 10. It is raised after the first failure of Newton's method, which
    stops after 14 iterations without a lower residual.
    """
    scene = rubber("quadrilateral", n=(8, 4))
    force = fem.Constant(scene.mesh, np.array([0.0, 5.0]))
    v = ufl.TestFunction(scene.u.function_space)
    scene.F -= ufl.inner(force, v) * ufl.dx(scene.mesh)
    scene.bcs.clear()
    ceiling = fc.HalfSpace((0.0, 1.0), (0.0, -1.0))
    contact = {"kinematics": kinematics}
    problem, _ = scene.problem(
        ceiling, fc.Coulomb(MU), contact=contact, small_displacement_tolerance=np.inf
    )
    problem.solve()
    problem.commit()
    made: list[int] = []
    problem.snes.setMonitor(lambda snes, iteration, norm: made.append(iteration))
    force.value[:], text = NOT_HELD[what]
    raised_everywhere(problem.solve, ValueError, text)
    # Measured: 18 residuals in all cases; a second attempt would have at least 14 more.
    assert len(made) <= 30


@pytest.mark.whole
@pytest.mark.parametrize("method", [None, "lbfgs", "newton", "alternating", "continuation"])
def test_soft_multipliers_that_hardly_grow_are_not_at_their_end(method):
    """A hundredth as stiff as the column, they take over 1 % of what they miss in a round.

    That is less than their tolerance of 4 % long before they bear the push. Friction bears all of
    it in the end, to the residual.
    """
    modulus, stiffness = 1000.0, 10.0
    scene = block("quadrilateral", E=modulus, nu=0.0, n=2)
    depth = fem.Constant(scene.mesh, 0.0)
    problem, contact = scene.problem(
        fc.Coulomb(MU, k_n=stiffness, k_t=stiffness),
        [scene.hold(TOP, 1, depth)],
        contact={"enforcement": "augmented", "tolerance": 0.04},
        small_displacement_tolerance=np.inf,
        method=method,
    )
    for force, share in ((1000.0, 0.5), (100.0, -0.25), (100.0, 0.625)):
        depth.value = -force / modulus
        scene.load(side=share * MU * force)
        problem.solve()
        problem.commit()
        found = contact.resultants().force[0]
        assert found == pytest.approx(-share * MU * force, rel=1e-6)


def test_blocks_on_both_sides_do_not_hide_an_overload():
    """A block squeezed by two others, with nothing else to hold it, is pushed by 2 % too much.

    Under a tenth of what squeezed it before, its multipliers fluctuate by more than their tolerance
    while it runs away, and by less than friction lacks. Measured: 1255 iterations; 6995 if the
    augmentations continue to the tolerance.
    """
    modulus, height = 1000.0, 0.5

    def made(low, n):
        corners = [(0.0, low), (1.0, low + height)]
        mesh = dolfinx.mesh.create_rectangle(MPI.COMM_WORLD, corners, (n, n))
        ends = {1: lambda x: np.isclose(x[1], low), 2: lambda x: np.isclose(x[1], low + height)}
        return mesh, None, sides(mesh, ends)

    joined = fc.join_meshes({"a": made(0.0, 2), "b": made(height, 1), "c": made(2 * height, 3)})
    space = fem.functionspace(joined.mesh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(space), ufl.TestFunction(space)
    depth, push = fem.Constant(joined.mesh, 0.0), fem.Constant(joined.mesh, 0.0)
    y = ufl.SpatialCoordinate(joined.mesh)[1]
    pushed = ufl.conditional(abs(y - 1.5 * height) < height / 2, push / height, 0.0)
    F = fc.elasticity.LinearElastic(u, modulus, nu=0.0, kind="plane strain").residual(v)
    F -= pushed * v[0] * ufl.dx
    floor, roof = joined.facet("a", 1), joined.facet("c", 2)
    bcs = [hold(u, joined.facets, tag, 0) for tag in (floor, roof)]
    bcs += [hold(u, joined.facets, floor, 1), hold(u, joined.facets, roof, 1, depth)]
    law = fc.Coulomb(MU, 100 * modulus, 100 * modulus)
    contacts = fc.find_contact_pairs(
        u, law, distance=0.05, bodies=joined, enforcement="augmented", tolerance=1e-4
    )
    problem = fc.ContactProblem(
        F, u, bcs=bcs, contacts=contacts, small_displacement_tolerance=np.inf, method="newton"
    )
    for force, share in ((10.0, 0.13), (1.0, 1.02)):
        depth.value, push.value = -force * 3 * height / modulus, 2 * share * MU * force
        if share < 1.0:
            problem.solve()
            problem.commit()
            continue
        with pytest.raises(fc.NotConverged, match=r"of body 2, .* the load is") as failed:
            problem.solve()
        assert failed.value.iterations < 1800


def groove(angle, n):
    """A wedge in a V groove, its sides at an angle from the vertical; loads down and along it."""
    mesh = dolfinx.mesh.create_box(
        MPI.COMM_WORLD, [(-0.5, 0.0, 0.0), (0.5, 1.0, 1.0)], n, dolfinx.mesh.CellType.hexahedron
    )
    tags = sides(mesh, {LEFT: plane(0, -0.5), RIGHT: plane(0, 0.5)})
    x = mesh.geometry.x
    x[:, 0] *= 2 * (0.3 + x[:, 2] * np.tan(angle))
    u = fem.Function(fem.functionspace(mesh, ("Lagrange", 1, (3,))), name="u")
    load, v = fem.Constant(mesh, np.zeros(3)), ufl.TestFunction(u.function_space)
    F = fc.elasticity.LinearElastic(u, 1000.0, nu=0.3, kind="3D").residual(v)
    F -= ufl.dot(load, v) * ufl.dx
    normal = np.cos(angle), np.sin(angle)
    contacts = [
        fc.Contact(
            u,
            fc.ContactSurface(mesh, tags, tag),
            fc.HalfSpace((side * 0.3, 0.0, 0.0), (-side * normal[0], 0.0, normal[1])),
            fc.Coulomb(0.5),
            name=f"side {tag}",
        )
        for tag, side in ((LEFT, -1), (RIGHT, 1))
    ]
    problem = fc.ContactProblem(F, u, contacts=contacts, small_displacement_tolerance=np.inf)
    volume = 0.6 + np.tan(angle)
    return problem, contacts, load, volume


@pytest.mark.parametrize(("n", "share", "before"), [((1, 2, 1), 0.9, 0.0), ((2, 2, 2), 0.8, 100.0)])
def test_a_wedge_in_a_groove_is_none(n, share, before):
    """Both sides press with N = P/(2 sin α), so that 2 μ N is borne along the groove.

    With more friction than there is, friction bears a part of P, too, and the sides press less: by
    those pressures both are overloads. The first is pressed and pushed at once, the second pressed
    by a hundred times as much before.
    """
    angle, down = np.radians(10.0), 10.0
    problem, contacts, load, volume = groove(angle, n)
    if before:
        load.value[2] = -before * down / volume
        problem.solve()
        problem.commit()
    along = share * 0.5 * down / np.sin(angle)
    load.value[:] = 0.0, along / volume, -down / volume
    problem.solve()
    force = sum(contact.resultants().force for contact in contacts)
    assert force == pytest.approx([0.0, -along, down], rel=1e-7, abs=1e-7 * down)


def test_the_larger_friction_of_two():
    """An ellipse bears across its direction what the limit along it would not."""
    scene = block("hexahedron", n=3, size=(1.0, 1.0, 0.25), up=-10.0)
    law = fc.Coulomb(MU, 1e5, 1e5, transverse_friction=2 * MU, direction=(0.0, 1.0, 0.0))
    problem, contact = scene.problem(law, [], small_displacement_tolerance=np.inf)
    problem.solve()
    problem.commit()
    scene.load(up=-10.0, side=1.8 * MU * 10.0)
    problem.solve()
    assert overload(problem) is None
    assert contact.resultants().force[0] == pytest.approx(-1.8 * MU * 10.0, rel=1e-6)


def test_polygons_and_where_nothing_is_told():
    """A polygon's corners count; forces without limit, and obstacles that turn, are left alone."""
    for modes, most in ((None, 1.0), (4, np.sqrt(2.0))):
        scene = block("hexahedron", n=2, size=(1.0, 1.0, 0.25), up=-10.0)
        law = fc.Tresca(MU, 10.0, 1e5, 1e5, modes=modes, direction=modes and (1.0, 0.0, 0.0))
        problem, _ = scene.problem(law, [])
        for share, is_found in ((0.99 * most, False), (1.01 * most, True)):
            scene.load(up=-10.0, side=share * MU * 10.0)
            assert (overload(problem) is not None) == is_found
    tresca = fc.Tresca(MU, 10.0, 1e5, 1e5)
    turned = fc.Rotation(None, (0.5, 0.5, 0.0), axis=(0.0, 0.0, 1.0), moment=1.0)
    turns = fc.HalfSpace((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), rotation=turned)
    for law, held, contact in (
        (fc.Foundation(1e5, 1e5), False, {}),
        (fc.Foundation(1e5, 1e5, tension=True), False, {}),
        (tresca, False, {"kinematics": "finite"}),
        (tresca, True, {"obstacle": turns, "kinematics": "finite"}),
    ):
        scene = block("hexahedron", n=2, size=(1.0, 1.0, 0.25), up=-10.0, side=4.0)
        bcs = [scene.hold(TOP, i) for i in range(3)] if held else []
        problem, _ = scene.problem(law, bcs, contact=contact)
        assert overload(problem) is None
