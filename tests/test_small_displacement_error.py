"""Small-displacement error: its estimate, the warning and the failure.

The reference is the same scene with the obstacle dragged instead of the body: its gap and normals
are those of its current position, which is exact; those of the dragged body are not.
"""

import warnings
from itertools import pairwise

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.checks.kinematics import spring_stiffness
from scenes.blocks import BOTTOM, TOP, Block, block, block_mesh
from scenes.comparison import is_close, point_values
from scenes.elasticity import displacement_space, stress

COMM = MPI.COMM_WORLD
RADIUS, DEPTH = 4.0, 0.05

pytestmark = pytest.mark.two_ranks


def dragged_block(
    cell="quadrilateral", *, body=0.0, obstacle=0.0, small_displacement_tolerance=np.inf, **options
):
    """Return a block pressed on a cylinder or ball by Dirichlet values, one of them dragged."""
    scene = block(cell, n=8 if cell == "quadrilateral" else 3, size=(2.0,) * options.pop("d", 2))
    d = scene.dim
    center = np.full(d, 1.0)
    center[-1] = -RADIUS
    motion = np.zeros(d)
    motion[0] = obstacle
    ball = fc.Ball(center, RADIUS, displacement=motion)
    bcs = [scene.dirichlet_bc(TOP, d - 1, -DEPTH), scene.dirichlet_bc(TOP, 0, body)]
    if d == 3:
        bcs.append(scene.dirichlet_bc(TOP, 1))
    problem, contact = scene.problem(
        fc.Frictionless(),
        bcs,
        contact={"obstacle": ball},
        small_displacement_tolerance=small_displacement_tolerance,
        **options,
    )
    return problem, contact


def solved(**scene):
    problem, contact = dragged_block(**scene)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        step = problem.solve()
    return step.verdict.small_displacement_error["contact"], contact.resultants().force


@pytest.mark.parametrize("options", [{}, {"condensation": False, "method": "lbfgs"}])
@pytest.mark.parametrize("displacement", [0.05, 0.2])
def test_estimate_is_the_difference_to_the_dragged_obstacle(displacement, options):
    """The estimate agrees with the difference to the dragged obstacle within a factor of two."""
    with_dragged_body, dragged = solved(body=-displacement, **options)
    nearly, exact = solved(obstacle=displacement, **options)
    missing = np.abs(dragged - exact).max() / np.linalg.norm(dragged)
    small = max(nearly.worst, with_dragged_body.force / 5)
    assert 0.5 * (missing - small) <= with_dragged_body.force <= 2 * (missing + small)
    assert missing > 0.005


def test_plane_has_no_small_displacement_error():
    """A body may slide far along a plane: the error is at most 1e-12."""
    scene = block("quadrilateral", n=4, up=-10.0)
    problem, contact = scene.problem(fc.Coulomb(0.1), [scene.dirichlet_bc(TOP, 0, 30.0)])
    step = problem.solve()
    assert step.verdict.small_displacement_error["contact"].worst <= 1e-12
    _, normal = contact.true_placement()
    assert is_close(
        point_values(contact, normal), point_values(contact, contact.values.normal), 1e-14
    )


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_gap_and_normal_at_the_deformed_position(cell):
    """`true_placement` gives distance and direction to the ball at X + u, to 1e-12."""
    d = 2 if cell == "quadrilateral" else 3
    problem, contact = dragged_block(cell, d=d, body=0.3)
    problem.u.interpolate(lambda x: np.stack([0.1 + 0.05 * x[0] - 0.02 * x[i] for i in range(d)]))
    contact.evaluate()
    gap, normal = contact.true_placement()
    center = np.full(d, 1.0)
    center[-1] = -RADIUS
    x = contact.points
    arm = x + np.stack([0.1 + 0.05 * x[:, 0] - 0.02 * x[:, i] for i in range(d)], axis=1) - center
    length = np.linalg.norm(arm, axis=1)
    assert is_close(point_values(contact, gap), point_values(contact, length - RADIUS), 1e-12)
    assert is_close(
        point_values(contact, normal), point_values(contact, -arm / length[:, None]), 1e-12
    )


def test_large_displacement_fails():
    problem, contact = dragged_block(body=-1.0, small_displacement_tolerance=0.2)
    with pytest.raises(fc.NotConverged, match="too large for the small-displacement"):
        problem.solve()
    assert is_close(contact.history.rows(), 0 * contact.history.rows(), 0.0, scale=1.0)


@pytest.mark.parametrize("condensation", [None, False])
def test_deformation_by_a_stiffness_in_wrong_units_fails(condensation):
    """A block deformed by over ten times its size fails, although gap and normal are exact.

    It is accepted with an infinite tolerance; a large Dirichlet value moves the block rigidly.
    """

    def pushed(E, top=0.0, **options):
        scene = block("quadrilateral", n=4, E=E, up=-1.0)
        bcs = [scene.dirichlet_bc(TOP, 0, fem.Constant(scene.mesh, top))]
        problem, _ = scene.problem(fc.Frictionless(), bcs, condensation=condensation, **options)
        return problem.solve()

    with pytest.raises(fc.NotConverged, match="times its size"):
        pushed(0.02)
    assert pushed(0.02, small_displacement_tolerance=np.inf).verdict.deformation["the body"] > 10
    assert pushed(1e6, top=50.0).verdict.deformation["the body"] < 0.1


def test_deformation_is_verified_with_the_recovered_interior():
    """Without its interior a deformation is unknown; `complete` finds that it is too large."""
    scene = block("quadrilateral", n=4, E=0.02, up=-1.0)
    bcs = [scene.dirichlet_bc(TOP, 0)]
    problem, _ = scene.problem(fc.Frictionless(), bcs, condensation=True)
    assert problem.solve(recover_interior=False).verdict.deformation == {}
    with pytest.raises(fc.NotConverged, match="times its size"):
        problem.complete()


def test_small_displacement_warning_is_repeated_at_each_doubling():
    """The warning is repeated when the error has doubled; every summary above 1 % states it."""
    problem, _ = dragged_block(body=-0.2, small_displacement_tolerance=0.5)
    with pytest.warns(UserWarning, match="assumed small") as caught:
        step = problem.solve()
    problem.commit()
    assert len(caught) == 1
    with_dragged_body = str(caught[0].message).split("deformed position ")[1].split(". With")[0]
    assert with_dragged_body in step.summary() and with_dragged_body in step._repr_html_()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.solve()
    first = step.verdict.small_displacement_error["contact"].worst
    moved, dragged, ratios = fem.Constant(problem.u.function_space.mesh, 0.0), [], []
    problem, _ = dragged_block(body=moved, small_displacement_tolerance=np.inf)
    for displacement in np.linspace(0.0, -0.4, 9):
        moved.value = displacement
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            step = problem.solve()
        problem.commit()
        dragged.append(any("assumed small" in str(w.message) for w in caught))
        ratios.append(step.verdict.small_displacement_error["contact"].worst)
        assert ("assumed small" in step.summary()) == (ratios[-1] > 0.01)
    warned = [
        ratio for ratio, with_dragged_body in zip(ratios, dragged, strict=True) if with_dragged_body
    ]
    assert len(warned) > 2 and warned[-1] > first
    assert all(b > 2 * a for a, b in pairwise(warned))
    assert max(ratios) <= 2 * warned[-1]


# ---- rotated scene -------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [30.0, 45.0])
def test_estimates_are_invariant_under_rotation(angle):
    """Small-displacement error and error budget of a rotated scene are the same, to 1e-5.

    The largest component instead of the norm would give a force error smaller by up to √2.
    """
    computed = []
    for turn in (0.0, np.deg2rad(angle)):
        c, s = np.cos(turn), np.sin(turn)
        q = np.array([[c, -s], [s, c]])
        mesh, tags = block_mesh("triangle", n=6)
        mesh.geometry.x[:, :2] = mesh.geometry.x[:, :2] @ q.T
        zero = np.zeros(2)
        scene = Block(
            mesh=mesh,
            tags=tags,
            u=fem.Function(displacement_space(mesh, 1), name="u"),
            E=fem.Constant(mesh, 1000.0),
            nu=fem.Constant(mesh, 0.3),
            traction=fem.Constant(mesh, zero),
            body_force=fem.Constant(mesh, zero),
            surface=fc.ContactSurface(mesh, tags, BOTTOM),
        )
        ball = fc.Ball(q @ [0.5, -2.0], 2.0)
        top = fem.Function(scene.u.function_space)
        top.x.array[:] = np.tile(q @ [-0.05, -0.02], top.x.array.size // 2)
        nodes = fem.locate_dofs_topological(scene.u.function_space, 1, tags.find(TOP))
        problem, _ = scene.problem(
            fc.Coulomb(0.2), [fem.dirichletbc(top, nodes)], contact={"obstacle": ball}
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            step = problem.solve()
        with_dragged_body = step.verdict.small_displacement_error["contact"]
        budget = fc.estimate_errors(problem, stress(scene.u, scene.E, scene.nu))
        computed.append([with_dragged_body.force, with_dragged_body.pressure])
        computed[-1] += [budget.values["displacement"], budget.parts["kinematics"]["displacement"]]
    assert min(computed[0][:2]) > 0.01
    assert computed[1] == pytest.approx(computed[0], rel=1e-5)


# ---- an obstacle whose displacement varies along Γc ----------------------------------------------


def error_with_tilted_floor(angle, formulation):
    """Return error and force of a block fixed at its top and a floor tilted by a displacement."""
    scene = block("quadrilateral", n=8)
    x = ufl.SpatialCoordinate(scene.mesh)
    floor = fc.HalfSpace((0.5, 0.02), (-np.sin(angle), np.cos(angle)))
    if formulation != "plane":
        space = scene.u.function_space
        if formulation == "function on Γc":
            space = fem.functionspace(scene.surface.submesh, ("Lagrange", 1, (2,)))
        motion = fem.Function(space)
        motion.interpolate(lambda x: np.stack([-angle * x[1], 0.02 + angle * (x[0] - 0.5)]))
        if formulation == "expression":
            motion = ufl.as_vector([-angle * x[1], 0.02 + angle * (x[0] - 0.5)])
        floor = fc.HalfSpace((0.5, 0.0), (0.0, 1.0), displacement=motion)
        if formulation == "profile":
            line = np.linspace(-2.0, 3.0, 21)
            points = np.stack([line, np.zeros_like(line)], axis=1)
            floor = fc.RigidProfile(points[::-1], displacement=motion)
    bcs = [scene.dirichlet_bc(TOP, 0), scene.dirichlet_bc(TOP, 1)]
    problem, contact = scene.problem(
        fc.Frictionless(), bcs, contact={"obstacle": floor}, small_displacement_tolerance=np.inf
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        step = problem.solve()
    return step.verdict.small_displacement_error["contact"], contact.resultants().force


@pytest.mark.each
@pytest.mark.parametrize("formulation", ["expression", "function", "function on Γc", "profile"])
def test_error_of_a_plane_tilted_by_its_displacement(formulation):
    """The estimate is the relative difference e to the tilted plane; zero if only shifted.

    It agrees within the larger of e/10 and e², at most 2 e²: second-order terms are neglected.
    """
    for angle in (0.03, 0.1):
        with_dragged_body, force = error_with_tilted_floor(angle, formulation)
        exact, reference = error_with_tilted_floor(angle, "plane")
        assert exact.worst == 0.0
        missing = np.linalg.norm(force - reference) / np.linalg.norm(force)
        assert with_dragged_body.force == pytest.approx(
            missing, abs=min(max(0.1 * missing, missing**2), 2 * missing**2)
        )
    with_dragged_body, _ = error_with_tilted_floor(0.0, formulation)
    assert with_dragged_body.worst <= 1e-3


def test_small_displacement_gives_no_warning():
    problem, _ = dragged_block(body=-1e-4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        step = problem.solve()
    assert step.verdict.small_displacement_error["contact"].worst < 0.01


def test_prescribed_gap_has_no_small_displacement_error():
    """A prescribed gap, unlike its normal, is not evaluated at X + u: the gap there is infinite."""
    scene = block("quadrilateral", n=4, up=-10.0)
    obstacle = fc.PrescribedGap(0.0, (0.0, -1.0))
    problem, contact = scene.problem(
        fc.Frictionless(), scene.rollers(), contact={"obstacle": obstacle}
    )
    assert problem.solve().verdict.small_displacement_error["contact"].worst == 0.0
    gap, _ = contact.true_placement()
    assert np.all(np.isinf(gap))


def test_error_budget_includes_the_small_displacement_error():
    """The kinematics part of the normal force is the difference to the dragged obstacle, to 1/3."""

    def solved(**scene):
        problem, contact = dragged_block(**scene)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            problem.solve()
        return problem, contact.resultants().normal_force

    problem, dragged = solved(body=-0.1)
    _, exact = solved(obstacle=0.1)
    plane = stress(problem.u, 1000.0, 0.3)
    with_dragged_body = fc.estimate_errors(problem, plane).parts["kinematics"]["normal force"]
    assert is_close(with_dragged_body, dragged - exact, 1 / 3)
    assert abs(dragged - exact) > 1e-3 * exact


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize(
    ("cell", "transverse"), [("triangle", None), ("tetrahedron", None), ("tetrahedron", 0.1)]
)
def test_estimate_includes_tangential_stiffness_of_slip(transverse, cell, enforcement):
    """Friction that turns with the slip direction has a tangential stiffness at slipping points.

    It may be all that constrains a body in 3D, and is zero in 2D. Reference: the derivative of the
    law's traction by UFL, to 1e-9 of the stiffness k_t.
    """
    d = 2 if cell == "triangle" else 3
    scene = block(cell, n=3, E=1e3)
    shift = fem.Constant(scene.mesh, np.zeros(d))
    options = {"transverse_friction": transverse, "direction": np.eye(d)[0]} if transverse else {}
    law = fc.Coulomb(0.3, 1e4, 1e3, **options)
    bcs = [scene.dirichlet_bc(TOP, i, -0.01 if i == d - 1 else 0.0) for i in range(d)]
    contact_options = {"displacement": shift, "enforcement": enforcement}
    problem, contact = scene.problem(law, bcs, contact=contact_options)
    problem.solve()
    problem.commit()
    shift.value[:2] = 0.02, 0.01 * (d - 2)
    problem.solve()
    slips, normal = contact.status == fc.Status.SLIP, contact.values.normal
    assert scene.mesh.comm.allreduce(int(slips.sum())) > 0
    flat = np.eye(d) - np.einsum("qi,qj->qij", normal, normal)
    computed = flat @ spring_stiffness(contact) @ flat
    exact = -flat @ contact.effective_law.tangent().by_jump @ flat
    largest = COMM.allreduce(np.abs(exact[slips]).max(initial=0.0), op=MPI.MAX)
    assert (largest > 1.0) == (d == 3)
    assert (
        COMM.allreduce(np.abs((computed - exact)[slips]).max(initial=0.0), op=MPI.MAX) < 1e-9 * 1e3
    )
