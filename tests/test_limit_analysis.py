"""Limit analysis reports loads above the friction limit, and no others."""

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.methods.limit_analysis import find_overloads
from scenes.blocks import LEFT, RIGHT, TOP, block
from scenes.comparison import assert_raised_on_all_ranks
from scenes.elasticity import dirichlet_bc
from scenes.rubber import rubber
from scenes.tags import plane, tag_by_nodes

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]

MU = 0.3
# ∫ r dA over the unit square, r from its middle: (√2 + asinh 1)/6 (polar coordinates).
LEVER = (np.sqrt(2.0) + np.arcsinh(1.0)) / 6
# A load of size r, perpendicular to the radius, has this moment: ∫ r² dA.
TURNED = 1 / 6


def twisted_cube(law, n=6, **options):
    """Return an unconstrained cube pressed on the floor by 10, its contact and twisting load."""
    scene = block("hexahedron", n=n, up=-10.0)
    twist, x = fem.Constant(scene.mesh, 0.0), ufl.SpatialCoordinate(scene.mesh)
    v = ufl.TestFunction(scene.u.function_space)
    around = ufl.as_vector([0.5 - x[1], x[0] - 0.5, 0.0])
    scene.F -= twist * ufl.dot(around, v) * ufl.ds(scene.mesh, subdomain_data=scene.tags)(TOP)
    problem, contact = scene.problem(law, [], small_displacement_tolerance=np.inf, **options)
    return problem, contact, twist


def overload(problem):
    """Return the overload that limit analysis finds for the present state and load, or None."""
    full = problem.full
    return next(iter(find_overloads(problem.motions, full.operators, full.present_load())), None)


def test_limit_moment_of_a_twisted_cube():
    """With Tresca friction the limit moment about the middle is the bound times ∫ r dA.

    Tolerance 1e-2, of which half is due to the quadrature of r, which has a kink in the middle.
    """
    problem, _, twist = twisted_cube(fc.Tresca(MU, 10.0, k_n=1e5, k_t=1e5))
    most = MU * 10.0 * LEVER / TURNED
    twist.value = 0.98 * most
    assert overload(problem) is None
    for load_factor in (1.02, 3.0):
        twist.value = load_factor * most
        detected = overload(problem)
        assert detected.factor == pytest.approx(load_factor, rel=1e-2)
        assert "rotation about z" in detected.describe()


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "newton", "lbfgs", "alternating", "continuation"])
def test_overload_is_reported_after_few_iterations(method):
    """With Tresca and Coulomb friction 0.9 of the limit moment is solved, and 1.1 is refused.

    Reference: statics, to 1e-6. The limit for Coulomb's law is found from the pressure of the
    twisted cube, which is not uniform.
    """
    for law in (fc.Tresca(MU, 10.0, k_n=1e5, k_t=1e5), fc.Coulomb(MU, k_n=1e5, k_t=1e5)):
        problem, contact, twist = twisted_cube(law, n=3, method=method)
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
        assert_raised_on_all_ranks(solve, fc.NotConverged, *words)
        # Measured: 0 to 138, including fallback methods; continuation uses at most 25 iterations
        # for each of three stiffnesses.
        assert failed[0].iterations < 200


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "lbfgs", "newton", "alternating", "continuation"])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_pressure_and_load_growing_together_is_no_overload(cell, method):
    """A pressure that grows a hundredfold with the tangential load is no overload."""
    scene = block(cell, n=4, up=-0.1)
    law = fc.Coulomb(MU, k_n=1e5, k_t=1e5)
    problem, contact = scene.problem(law, [], small_displacement_tolerance=np.inf, method=method)
    problem.solve()
    problem.commit()
    scene.load(up=-10.0, side=0.9 * MU * 10.0)
    problem.solve()
    computed = contact.resultants()
    assert computed.force[0] == pytest.approx(-0.9 * MU * 10.0, rel=1e-6)
    assert computed.normal_force == pytest.approx(10.0, rel=1e-6)


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "lbfgs", "newton", "alternating", "continuation"])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
@pytest.mark.parametrize("loading", ["top", "gap"])
def test_tight_fit_is_no_overload(loading, cell, method):
    """A block clamped by prescribed displacements and pushed in one increment is no overload.

    Contact that is softened during the solution has less pressure and less friction than the
    solution. Reference: a column of stiffness E / h in series with k_n, area 1:
    N = δ / (h / E + 1 / k_n), to 1e-6.
    """
    modulus, stiffness, depth = 1000.0, 1e5, 1e-3
    scene = block(cell, E=modulus, nu=0.0, n=4)
    pressed = scene.dirichlet_bc(
        TOP, scene.mesh.geometry.dim - 1, -depth if loading == "top" else 0.0
    )
    law, contact = fc.Coulomb(MU, k_n=stiffness, k_t=stiffness), {}
    if loading == "gap":
        contact["gap"] = -depth
    problem, contact = scene.problem(
        law, [pressed], contact=contact, small_displacement_tolerance=np.inf, method=method
    )
    force = depth / (1 / modulus + 1 / stiffness)
    scene.load(side=0.8 * MU * force)
    problem.solve()
    computed = contact.resultants()
    assert computed.force[0] == pytest.approx(-0.8 * MU * force, rel=1e-6)
    assert computed.normal_force == pytest.approx(force, rel=1e-6)


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "lbfgs", "newton", "alternating", "continuation"])
@pytest.mark.parametrize("stiffness", [1e1, 1e3])
@pytest.mark.parametrize("load_factor", [0.7, 0.8, 0.97])
@pytest.mark.parametrize("loading", ["top", "gap"])
def test_tight_fit_with_multipliers_and_soft_springs_is_no_overload(
    loading, load_factor, stiffness, method
):
    """The load exceeds the limit of the springs before augmentation, but not that of multipliers.

    Reference: only the column deforms, N = δ E / h. The penalty part may be as large as the
    tolerance times N, which changes N by E / (h k) times that; one tolerance is added.
    """
    modulus, depth, tolerance = 1000.0, 1e-3, 1e-6
    scene = block("quadrilateral", E=modulus, nu=0.0, n=4)
    pressed = scene.dirichlet_bc(TOP, 1, -depth if loading == "top" else 0.0)
    contact = {"enforcement": "augmented", "tolerance": tolerance}
    if loading == "gap":
        contact["gap"] = -depth
    problem, contact = scene.problem(
        fc.Coulomb(MU, k_n=stiffness, k_t=stiffness),
        [pressed],
        contact=contact,
        small_displacement_tolerance=np.inf,
        method=method,
    )
    force = depth * modulus
    scene.load(side=load_factor * MU * force)
    problem.solve()
    computed = contact.resultants()
    assert computed.force[0] == pytest.approx(-load_factor * MU * force, rel=10 * tolerance)
    assert computed.normal_force == pytest.approx(force, rel=(1 + modulus / stiffness) * tolerance)


# Body forces on an area of 2, and the error text about their resultant and the contact force.
UNCONSTRAINED = {
    "falls": ((0.0, -1.0), "translation along y) is -2, of which contact can balance at most 0 "),
    "pushed": ((2.0, 5.0), "translation along x) is 4, of which contact can balance at most 3 "),
}


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("case", UNCONSTRAINED)
def test_unconstrained_rubber_is_refused_with_limit_load(case, kinematics):
    """Rubber pressed against a ceiling by a body force of 5 then falls, or is pushed by too much.

    The error states the rigid-body mode, the load along it, and the largest contact force along it,
    by statics 0 or μ N = 0.3 · 10. It is raised after the first failure of Newton's method, which
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
    iterations: list[int] = []
    problem.snes.setMonitor(lambda snes, iteration, norm: iterations.append(iteration))
    force.value[:], text = UNCONSTRAINED[case]
    assert_raised_on_all_ranks(problem.solve, ValueError, text)
    # Measured: 18 residuals in all cases; a second attempt would have at least 14 more.
    assert len(iterations) <= 30


@pytest.mark.whole
@pytest.mark.parametrize("method", [None, "lbfgs", "newton", "alternating", "continuation"])
def test_slow_augmentations_are_continued_to_equilibrium(method):
    """Augmentations that change multipliers by less than the tolerance are continued if needed.

    Springs of a hundredth of the column's stiffness correct 1 % of the error per augmentation, less
    than the tolerance of 4 %, long before friction balances the load. Reference: in the end
    friction balances it to 1e-6.
    """
    modulus, stiffness = 1000.0, 10.0
    scene = block("quadrilateral", E=modulus, nu=0.0, n=2)
    depth = fem.Constant(scene.mesh, 0.0)
    problem, contact = scene.problem(
        fc.Coulomb(MU, k_n=stiffness, k_t=stiffness),
        [scene.dirichlet_bc(TOP, 1, depth)],
        contact={"enforcement": "augmented", "tolerance": 0.04},
        small_displacement_tolerance=np.inf,
        method=method,
    )
    for force, load_factor in ((1000.0, 0.5), (100.0, -0.25), (100.0, 0.625)):
        depth.value = -force / modulus
        scene.load(side=load_factor * MU * force)
        problem.solve()
        problem.commit()
        computed = contact.resultants().force[0]
        assert computed == pytest.approx(-load_factor * MU * force, rel=1e-6)


def clamped_blocks(factors, **options):
    """Return a problem of blocks that two others each clamp, side by side, and its load.

    The load function sets the clamping force of every block, and its push in units of that force
    times 2 μ, times a factor for each.
    """
    modulus, height, n_blocks = 1000.0, 0.5, len(factors)

    def make_block(left, low, n):
        corners = [(left, low), (left + 1.0, low + height)]
        mesh = dolfinx.mesh.create_rectangle(MPI.COMM_WORLD, corners, (n, n))
        ends = {1: lambda x: np.isclose(x[1], low), 2: lambda x: np.isclose(x[1], low + height)}
        return mesh, None, tag_by_nodes(mesh, ends)

    layers = {"floor": (0, 2), "block": (1, 1), "roof": (2, 3)}
    joined = fc.join_meshes(
        {
            f"{name} {number}": make_block(2.0 * number, layer * height, n)
            for number in range(n_blocks)
            for name, (layer, n) in layers.items()
        }
    )
    space = fem.functionspace(joined.mesh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(space), ufl.TestFunction(space)
    depth, push = fem.Constant(joined.mesh, 0.0), fem.Constant(joined.mesh, 0.0)
    x, y = ufl.SpatialCoordinate(joined.mesh)
    bcs = []
    F = fc.elasticity.LinearElastic(u, modulus, nu=0.0, kind="plane strain").residual(v)
    for number, factor in enumerate(factors):
        floor, roof = joined.facet(f"floor {number}", 1), joined.facet(f"roof {number}", 2)
        bcs += [dirichlet_bc(u, joined.facets, tag, 0) for tag in (floor, roof)]
        bcs += [
            dirichlet_bc(u, joined.facets, floor, 1),
            dirichlet_bc(u, joined.facets, roof, 1, depth),
        ]
        pushed = ufl.And(abs(y - 1.5 * height) < height / 2, abs(x - 2 * number - 0.5) < 1.0)
        F -= ufl.conditional(pushed, factor * push / height, 0.0) * v[0] * ufl.dx
    law = fc.Coulomb(MU, 100 * modulus, 100 * modulus)
    contacts = fc.find_contact_pairs(u, law, distance=0.05, bodies=joined, **options)
    problem = fc.ContactProblem(
        F, u, bcs=bcs, contacts=contacts, small_displacement_tolerance=np.inf, method="newton"
    )

    def load(force, fraction):
        depth.value, push.value = -force * 3 * height / modulus, 2 * fraction * MU * force

    return problem, load


def test_overload_of_a_clamped_block_is_reported():
    """A block constrained only by two clamping blocks is reported at 2 % above the friction limit.

    At a tenth of the previous clamping force its multipliers fluctuate, while it slides, by more
    than their tolerance and by less than the missing friction. Measured: 445 iterations.
    """
    problem, load = clamped_blocks([1.0], enforcement="augmented", tolerance=1e-4)
    load(10.0, 0.13)
    problem.solve()
    problem.commit()
    load(1.0, 1.02)
    with pytest.raises(fc.NotConverged, match=r"of body 2, .* the load is") as failed:
        problem.solve()
    assert failed.value.iterations < 900


@pytest.mark.parametrize(
    ("factors", "body"),
    [([1.3, 1.1], "body 2"), ([0.5, 1.1], "body 5"), ([1.1, 1.1], "body [25]")],
)
def test_overloads_of_two_clamped_blocks_at_once(factors, body):
    """The larger overload is reported, of blocks that slide independently of each other.

    Reference: the limit 2 μ N of each block, to 1e-3. N is the clamping displacement by the
    compliance of three layers of height h/E and of two contacts, 2/k_n.
    """
    force, height, modulus = 0.01, 0.5, 1000.0
    problem, load = clamped_blocks(factors)
    load(force, 0.5)
    problem.solve()
    problem.commit()
    load(force, 1.0)
    with pytest.raises(fc.NotConverged, match=rf"along x of {body}, .* the load is") as failed:
        problem.solve()
    stated = float(str(failed.value).split("can balance at most ")[1].split()[0])
    compliance = 3 * height / modulus + 2 / (100 * modulus)
    pressed = force * 3 * height / modulus / compliance
    assert stated == pytest.approx(2 * MU * pressed, rel=1e-3)


def groove(angle, n):
    """Return the problem of a wedge in a V groove, its contacts, its load and its volume.

    The sides of the groove are at an angle from the vertical.
    """
    mesh = dolfinx.mesh.create_box(
        MPI.COMM_WORLD, [(-0.5, 0.0, 0.0), (0.5, 1.0, 1.0)], n, dolfinx.mesh.CellType.hexahedron
    )
    tags = tag_by_nodes(mesh, {LEFT: plane(0, -0.5), RIGHT: plane(0, 0.5)})
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


@pytest.mark.parametrize(
    ("n", "load_factor", "before"), [((1, 2, 1), 0.9, 0.0), ((2, 2, 2), 0.8, 100.0)]
)
def test_wedge_in_a_groove_below_its_limit_is_no_overload(n, load_factor, before):
    """A wedge pushed along its groove by less than 2 μ N, N = P/(2 sin α), is no overload.

    At a larger friction coefficient friction also balances a part of P, and N decreases: with those
    pressures both cases would be overloads. The first one is pressed and pushed in one increment,
    the second was pressed by a hundred times as much before. Reference: the load, to 1e-7.
    """
    angle, down = np.radians(10.0), 10.0
    problem, contacts, load, volume = groove(angle, n)
    if before:
        load.value[2] = -before * down / volume
        problem.solve()
        problem.commit()
    along = load_factor * 0.5 * down / np.sin(angle)
    load.value[:] = 0.0, along / volume, -down / volume
    problem.solve()
    force = sum(contact.resultants().force for contact in contacts)
    assert force == pytest.approx([0.0, -along, down], rel=1e-7, abs=1e-7 * down)


def test_transverse_friction_of_an_ellipse_is_no_overload():
    """An ellipse balances a transverse load that is above the limit along its direction."""
    scene = block("hexahedron", n=3, size=(1.0, 1.0, 0.25), up=-10.0)
    law = fc.Coulomb(MU, 1e5, 1e5, transverse_friction=2 * MU, direction=(0.0, 1.0, 0.0))
    problem, contact = scene.problem(law, [], small_displacement_tolerance=np.inf)
    problem.solve()
    problem.commit()
    scene.load(up=-10.0, side=1.8 * MU * 10.0)
    problem.solve()
    assert overload(problem) is None
    assert contact.resultants().force[0] == pytest.approx(-1.8 * MU * 10.0, rel=1e-6)


def test_limit_analysis_of_polygons_and_unsupported_cases():
    """The limit of a polygon is at its corners; unsupported cases are never overloads.

    Those are foundations, finite kinematics and rotating obstacles.
    """
    for modes, most in ((None, 1.0), (4, np.sqrt(2.0))):
        scene = block("hexahedron", n=2, size=(1.0, 1.0, 0.25), up=-10.0)
        law = fc.Tresca(MU, 10.0, 1e5, 1e5, modes=modes, direction=modes and (1.0, 0.0, 0.0))
        problem, _ = scene.problem(law, [])
        for load_factor, is_found in ((0.99 * most, False), (1.01 * most, True)):
            scene.load(up=-10.0, side=load_factor * MU * 10.0)
            assert (overload(problem) is not None) == is_found
    tresca = fc.Tresca(MU, 10.0, 1e5, 1e5)
    turned = fc.Rotation(None, (0.5, 0.5, 0.0), axis=(0.0, 0.0, 1.0), moment=1.0)
    turns = fc.HalfSpace((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), rotation=turned)
    for law, constrained, contact in (
        (fc.Foundation(1e5, 1e5), False, {}),
        (fc.Foundation(1e5, 1e5, tension=True), False, {}),
        (tresca, False, {"kinematics": "finite"}),
        (tresca, True, {"obstacle": turns, "kinematics": "finite"}),
    ):
        scene = block("hexahedron", n=2, size=(1.0, 1.0, 0.25), up=-10.0, side=4.0)
        bcs = [scene.dirichlet_bc(TOP, i) for i in range(3)] if constrained else []
        problem, _ = scene.problem(law, bcs, contact=contact)
        assert overload(problem) is None
