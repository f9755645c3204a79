"""Return map and committed history against numpy, and a benchmark with contact springs."""

from dataclasses import dataclass

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import BOTTOM, CELLS, GRID, RIGHT, block, block_mesh, dimension, polynomial
from scenes.comparison import gather, is_close, is_interpolant
from scenes.elasticity import displacement_space

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD

K_N, K_T, FRICTION = 100.0, 60.0, 0.3
# Round-off of the return map: some twenty operations on numbers of size one at each point.
EXACT = 1e-12


@dataclass
class PointLaw:
    """The paper's return map (eq. 6-11, 41-45) with its history at every point, in plain numpy.

    Attributes:
        s: Initial gap, shape (n,).
        normal: Unit normal, shape (n, d).
        tau, u, beta: Committed traction (n, d), displacement (n, d), slip per mode (n, m).
    """

    s: np.ndarray
    normal: np.ndarray
    tau: np.ndarray
    u: np.ndarray
    beta: np.ndarray

    def along(self, u: np.ndarray) -> np.ndarray:
        """Return the normal displacement u_n, shape (n,)."""
        return np.sum(u * self.normal, axis=1)

    def tangential(self, u: np.ndarray) -> np.ndarray:
        """Return the tangential displacement u_t, shape (n, d)."""
        return u - self.along(u)[:, None] * self.normal

    def step(self, u: np.ndarray, mu: float, k_n: float, k_t: float) -> dict[str, np.ndarray]:
        """Return the fields after an increment to ``u``; the history does not change."""
        opening = np.maximum(self.s - self.along(u), 0)
        penetration = np.maximum(self.along(u) - self.s, 0)
        closed = penetration > 0
        r_n = -k_n * penetration
        trial = self.tau - k_t * self.tangential(u - self.u)
        if u.shape[1] == 2:
            # g_τ = (1, -1) along the normal turned left by a right angle, eq. (29, 30).
            across = np.column_stack([-self.normal[:, 1], self.normal[:, 0]])
            g_tau = np.array([1.0, -1.0])
            size = np.sum(trial * across, axis=1)
            g = size[:, None] * g_tau + (mu * r_n)[:, None]
            beta = np.maximum(g, 0) / k_t
            tau = (size - k_t * beta @ g_tau)[:, None] * across
        else:
            size = np.linalg.norm(trial, axis=1)
            g = (size + mu * r_n)[:, None]
            beta = np.maximum(g, 0) / k_t
            tau = trial * (1 - k_t * beta / np.where(size > 0, size, 1)[:, None])
        beta = np.where(closed[:, None], beta, 0)
        tau = np.where(closed[:, None], tau, 0)
        stick = closed & np.all(beta == 0, axis=1)
        status = np.where(closed, np.where(stick, fc.Status.STICK, fc.Status.SLIP), fc.Status.OPEN)
        # Smallest distance of a point to a change of status: must be above round-off.
        kinks = np.concatenate([opening + penetration, np.abs(g[closed]).ravel() / k_t])
        return {
            "opening": opening,
            "penetration": penetration,
            "normal_traction": r_n,
            "traction": tau,
            "slip_increment": beta,
            "status": status,
            "margin": np.array([kinks.min()]),
        }

    def commit(self, u: np.ndarray, fields: dict[str, np.ndarray]) -> None:
        """Make the fields of an increment the history."""
        self.tau, self.u = fields["traction"], u
        self.beta = self.beta + fields["slip_increment"]


# Partial approach, stick, slip, small reversal, reversed slip, opening, motion while open, closing,
# slip: displacement along the normal and tangential to it (in 3D in two directions), and statuses
# that some points must have.
OPEN, STICK, SLIP = fc.Status.OPEN, fc.Status.STICK, fc.Status.SLIP
PATH = [
    (0.075, (0.0, 0.0), {OPEN}),
    (0.12, (0.004, 0.002), {STICK}),
    (0.13, (0.2, 0.07), {SLIP}),
    (0.13, (0.195, 0.068), {STICK}),
    (0.125, (-0.05, 0.15), {SLIP}),
    (0.07, (-0.05, 0.15), {OPEN}),
    (-0.1, (-0.05, 0.15), {OPEN}),
    (-0.1, (-0.5, 0.9), {OPEN}),
    (0.12, (-0.505, 0.904), {STICK}),
    (0.13, (-0.1, 0.7), {SLIP}),
]


class Scene:
    """Γc on two sides of a shuffled mesh, with varying gap and normal in UFL and numpy."""

    def __init__(self, cell: str, degree: int) -> None:
        """Create the contact; u is zero."""
        self.d = d = dimension(cell)
        self.degree = degree
        mesh, tags = block_mesh(cell, shuffled=True)
        self.u = fem.Function(displacement_space(mesh, degree))
        surface = fc.ContactSurface(mesh, tags, [BOTTOM, RIGHT])
        x = ufl.SpatialCoordinate(mesh)
        normal = [0.3 * x[0] - 0.1, *([0.2 * x[1]] if d == 3 else []), -1.5]
        obstacle = fc.PrescribedGap(
            0.08 + 0.03 * x[0] ** 2 - 0.01 * x[d - 1], ufl.as_vector(normal)
        )
        law = fc.Coulomb(FRICTION, k_n=K_N, k_t=K_T)
        self.contact = fc.Contact(self.u, surface, obstacle, law)
        self.x = gather(COMM, self.contact.points)

    def reference(self) -> PointLaw:
        """Return the return map in numpy with this gap and normal, without history."""
        x, d = self.x, self.d
        s = 0.08 + 0.03 * x[:, 0] ** 2 - 0.01 * x[:, -1]
        normal = [0.3 * x[:, 0] - 0.1, *([0.2 * x[:, 1]] if d == 3 else []), 0 * s - 1.5]
        normal = np.column_stack(normal)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        m = 2 if d == 2 else 1
        return PointLaw(s, normal, np.zeros_like(x), np.zeros_like(x), np.zeros((len(x), m)))

    def displacement(self, number: int):
        """Return an increment's displacement: a mean and a polynomial of the element's degree."""
        along, across, _ = PATH[number]
        mean = np.zeros(self.d)
        mean[:-1], mean[-1] = across[: self.d - 1], -along
        field = polynomial(self.d, self.degree, 100 + number, 0.003)
        return lambda x: mean[:, None] + field(x)


@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_history_equals_the_return_map_in_numpy(cell, degree):
    """Ten increments equal the pointwise return map in numpy, at all points of all ranks.

    Compared are traction, δ₊, δ₋, Δβ and β of each mode, and status. Reference: `PointLaw` with
    analytic displacements at the points. Tolerance 1e-12 of the largest value: round-off.
    """
    scene = Scene(cell, degree)
    contact, law = scene.contact, scene.reference()
    statuses: set[int] = set()
    for number, (_, _, reference) in enumerate(PATH):
        field = scene.displacement(number)
        scene.u.interpolate(field)
        contact.evaluate()
        u = field(scene.x.T).T
        expected = law.step(u, FRICTION, K_N, K_T)
        assert expected["margin"][0] > 1e-9, f"increment {number} is decided by rounding"
        values = {name: gather(COMM, v) for name, v in contact.values.arrays.items()}
        for name in ("opening", "penetration", "normal_traction", "traction", "slip_increment"):
            scale = {"opening": 0.1, "penetration": 0.1, "slip_increment": 0.1}.get(name, 1.0)
            assert is_close(values[name], expected[name], EXACT, scale=scale), (number, name)
        status = gather(COMM, contact.status)
        assert np.array_equal(status, expected["status"]), number
        assert reference <= set(status.tolist()), number
        statuses |= set(status.tolist())
        # The slip is unchanged before the commit.
        assert is_close(gather(COMM, contact.slip), law.beta, EXACT, scale=1.0), number
        contact.commit()
        law.commit(u, expected)
        assert is_close(gather(COMM, contact.slip), law.beta, EXACT, scale=1.0), number
        for name, value in (("traction", law.tau), ("jump", law.u)):
            committed = gather(COMM, contact.history.values(name))
            assert is_close(committed, value, EXACT, scale=1.0), (number, name)
        # The public results have the same values.
        assert is_close(
            gather(COMM, contact.pressure), -expected["normal_traction"], EXACT, scale=1
        )
        gap = expected["opening"] - expected["penetration"]
        assert is_close(gather(COMM, contact.gap), gap, EXACT, scale=0.1)
    assert statuses == {OPEN, STICK, SLIP}
    assert law.beta.min() > 0.1  # every mode of every point has slipped


@pytest.mark.parametrize("cell", CELLS)
def test_resultants_are_sums_over_the_points(cell):
    """Force, area and counts equal sums in numpy on every rank, to round-off (1e-12)."""
    scene = Scene(cell, 1)
    contact = scene.contact
    law = scene.reference()
    for number in range(4):
        scene.u.interpolate(scene.displacement(number))
        u = scene.displacement(number)(scene.x.T).T
        expected = law.step(u, FRICTION, K_N, K_T)
        contact.evaluate()
        w = gather(COMM, contact.quadrature.weights)
        total = expected["normal_traction"][:, None] * law.normal + expected["traction"]
        closed = expected["status"] != OPEN
        for r in COMM.allgather(contact.resultants()):
            assert is_close(r.force, w @ total, EXACT, scale=10.0)
            assert abs(r.normal_force + w @ expected["normal_traction"]) <= EXACT * 10
            size = np.linalg.norm(expected["traction"], axis=1)
            assert abs(r.tangential_force - w @ size) <= EXACT * 10
            assert abs(r.area - w @ closed) <= EXACT * 2
            counts = [int(np.sum(expected["status"] == s)) for s in (OPEN, STICK, SLIP)]
            assert [r.open, r.stick, r.slip] == counts
            assert abs(r.max_penetration - expected["penetration"].max()) <= EXACT
        contact.commit()
        law.commit(u, expected)


@pytest.mark.parametrize("cell", CELLS)
def test_gather_returns_all_points_in_order(cell):
    """`gather` returns the values of all points on every rank, ordered by coordinates."""
    scene = Scene(cell, 1)
    contact = scene.contact
    for number in range(3):
        scene.u.interpolate(scene.displacement(number))
        contact.commit()
    table = contact.gather()
    size = np.abs(table["x"]).max()
    assert np.all(np.diff(table["x"][:, 0]) >= -1e-9 * size)  # coordinates are compared to 1e-9
    columns = {
        "x": contact.points,
        "normal": contact.values.normal,
        "tangential_traction": contact.tangential_traction,
        "gap": contact.gap,
        "pressure": contact.pressure,
        "slip": contact.slip.sum(axis=1),
        "status": contact.status,
        "measure": contact.measure,
    }
    columns = {name: gather(COMM, value) for name, value in columns.items()}
    order = np.lexsort(np.round(columns["x"] / size, 9).T[::-1])
    for name, value in columns.items():
        assert np.array_equal(table[name], value[order]), name


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_evaluation_does_not_change_the_history(cell):
    """Evaluations between two commits leave the history the same to the last bit."""
    scene = Scene(cell, 1)
    for number in range(3):
        scene.u.interpolate(scene.displacement(number))
        scene.contact.commit()
    before = scene.contact.history.function.x.array.copy()
    for number in (7, 4, 9):
        scene.u.interpolate(scene.displacement(number))
        scene.contact.evaluate()
        scene.contact.resultants()
        scene.contact.gather()
    after = scene.contact.history.function.x.array
    assert all(COMM.allgather(bool(np.array_equal(before, after))))


@pytest.mark.parametrize("cell", CELLS)
def test_reopened_points_lose_their_traction(cell):
    """Reopened points have no traction and close again without; motion while open is not slip.

    The motions are uniform and the values computed by hand: δ₋ = 0.05, friction bound
    0.3*100*0.05 = 1.5. Tolerance 1e-12: round-off.
    """
    d = dimension(cell)
    mesh, tags = block_mesh(cell, shuffled=True)
    u = fem.Function(displacement_space(mesh, 1))
    floor = fc.HalfSpace(np.zeros(d), np.eye(d)[-1])
    law = fc.Coulomb(FRICTION, k_n=K_N, k_t=K_T)
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, BOTTOM), floor, law, gap=0.1)

    def move(side: float, down: float) -> None:
        value = np.zeros(d)
        value[0], value[-1] = side, -down
        u.interpolate(lambda x: np.outer(value, np.ones(x.shape[1])))
        contact.commit()

    def state() -> tuple[np.ndarray, np.ndarray]:
        """Return the traction along x and the accumulated slip of all modes at all points."""
        tau = gather(COMM, contact.history.values("traction"))
        return tau[:, 0], gather(COMM, contact.slip).sum(axis=1)

    def expect(tau: float, slip: float) -> None:
        for actual, value in zip(state(), (tau, slip), strict=True):
            assert is_close(actual, np.full(actual.shape, value), EXACT, scale=1.0)

    move(0.0, 0.15)
    expect(0.0, 0.0)
    move(0.01, 0.15)  # sticks: 60 * 0.01
    expect(-0.6, 0.0)
    move(0.1, 0.15)  # trial 6, bound 1.5
    expect(-1.5, 4.5 / 60)
    move(0.1, 0.05)  # opens
    expect(0.0, 4.5 / 60)
    move(7.0, 0.05)  # moves while open
    expect(0.0, 4.5 / 60)
    move(7.0, 0.15)  # closes along the normal: no earlier traction remains
    expect(0.0, 4.5 / 60)
    move(6.99, 0.15)  # sticks: 60 * 0.01 in the other direction
    expect(0.6, 4.5 / 60)
    move(6.95, 0.15)  # trial 3, bound 1.5
    expect(1.5, 4.5 / 60 + 1.5 / 60)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_history_of_a_moving_obstacle(cell):
    """Moving the obstacle by -a is equivalent to moving the body by a, to round-off (1e-12)."""
    d = dimension(cell)
    mesh, tags = block_mesh(cell, shuffled=True)
    surface = fc.ContactSurface(mesh, tags, BOTTOM)
    motion = fem.Constant(mesh, np.zeros(d))
    law = fc.Coulomb(FRICTION, k_n=K_N, k_t=K_T)
    up = np.eye(d)[-1]
    body, obstacle_field = (fem.Function(displacement_space(mesh, 1)) for _ in range(2))
    moved = fc.Contact(body, surface, fc.HalfSpace(np.zeros(d), up), law, gap=0.1)
    pushed = fc.Contact(
        obstacle_field, surface, fc.HalfSpace(np.zeros(d), up, displacement=motion), law, gap=0.1
    )
    obstacle_field.interpolate(polynomial(d, 1, 3, 0.003))
    for side, down in ((0.0, 0.15), (0.01, 0.15), (0.2, 0.16), (0.15, 0.16), (0.1, 0.0), (0, 0.14)):
        value = np.zeros(d)
        value[0], value[-1] = side, -down
        body.x.array[:] = obstacle_field.x.array + np.tile(value, obstacle_field.x.array.size // d)
        motion.value[:] = -value
        for contact in (moved, pushed):
            contact.commit()
        for name in ("gap", "traction", "slip"):
            a, b = (gather(COMM, getattr(c, name)) for c in (moved, pushed))
            assert is_close(b, a, EXACT, scale=10.0), (name, side, down)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", CELLS)
def test_contact_spring(cell, method):
    """Code_Aster SSND116A: k_n = 1, k_t = 0.5, μ = 0.5, gap 0.5, unit springs, by `solve`.

    Springs per area, load and contact all act on the bottom of the block, which therefore moves as
    a rigid body without deformation. The force N increases to 1, then T to 2 and back to 0.
    Reference: values of the benchmark, to its tolerance 1e-6, far above the solver's 1e-9.
    """
    scene = block(cell)
    d = scene.dim
    ds = ufl.ds(scene.mesh, subdomain_data=scene.tags)(BOTTOM)
    v = ufl.TestFunction(scene.u.function_space)
    force = fem.Constant(scene.mesh, np.zeros(d))
    scene.F += ufl.dot(scene.u - force, v) * ds
    law = fc.Coulomb(0.5, k_n=1.0, k_t=0.5)
    problem, contact = scene.problem(law, [], contact={"gap": 0.5}, method=method)
    history = [
        # N, T, u_n, u_t, status
        (0.25, 0.0, -0.25, 0.0, OPEN),
        (0.5, 0.0, -0.5, 0.0, None),  # just touches
        (0.75, 0.0, -0.625, 0.0, STICK),
        (1.0, 0.0, -0.75, 0.0, STICK),
        (1.0, 0.1, -0.75, 0.1 / 1.5, STICK),
        (1.0, 0.2, -0.75, 0.133333333, STICK),
        (1.0, 1.0, -0.75, 0.875, SLIP),
        (1.0, 2.0, -0.75, 1.875, SLIP),
        (1.0, 1.8, -0.75, 1.741666667, STICK),
        (1.0, 0.5, -0.75, 0.625, SLIP),
        (1.0, 0.0, -0.75, 0.125, SLIP),
    ]
    for normal, tangential, u_n, u_t, status in history:
        force.value[:] = scene.vector(side=tangential, up=-normal)
        problem.solve()
        problem.commit()
        expected = scene.vector(side=u_t, up=u_n)
        assert is_interpolant(
            scene.u, lambda x, e=expected: np.outer(e, np.ones(x.shape[1])), 1e-6, scale=1.0
        ), (normal, tangential)
        if status is not None:
            assert np.all(gather(COMM, contact.status) == status), (normal, tangential)
