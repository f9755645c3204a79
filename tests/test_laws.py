"""Contact laws: residual and tangent as derivatives, symmetry, and parameters."""

from dataclasses import dataclass

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from scenes.blocks import BOTTOM, CELLS, GRID, RIGHT, block_mesh, dimension, polynomial, rough_field
from scenes.comparison import (
    assemble_matrix,
    assemble_owned,
    assemble_scalar,
    assert_raised_on_all_ranks,
    compile_with_maps,
    gather,
    is_close,
    owned_values,
    set_owned,
)
from scenes.elasticity import displacement_space

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD

K_N, K_T, FRICTION, PRESSURE = 100.0, 60.0, 0.3, 9.0
NORMAL = {2: np.array([0.3, -1.0]), 3: np.array([0.3, -0.2, -1.0])}

LAWS = {
    "frictionless": fc.Frictionless(k_n=K_N),
    "tresca": fc.Tresca(FRICTION, PRESSURE, k_n=K_N, k_t=K_T),
    "prescribed": fc.Tresca(FRICTION, PRESSURE, k_t=K_T, unilateral=False),
    "coulomb": fc.Coulomb(FRICTION, k_n=K_N, k_t=K_T),
    "compliance": fc.NormalCompliance(FRICTION, PRESSURE, 0.08, 2.0, k_t=K_T),
    "foundation": fc.Foundation(K_N, K_T),
    "foundation, closed only": fc.Foundation(K_N, K_T, tension=False),
}
ELLIPSE = {"transverse_friction": 0.2, "direction": (1.0, 0.4, 0.2)}
LAWS_3D = {
    "coulomb, polygon": fc.Coulomb(FRICTION, k_n=K_N, k_t=K_T, modes=5),
    "coulomb, ellipse": fc.Coulomb(FRICTION, k_n=K_N, k_t=K_T, **ELLIPSE),
    "tresca, polygon": fc.Tresca(FRICTION, PRESSURE, k_n=K_N, k_t=K_T, modes=5),
    "tresca, ellipse": fc.Tresca(FRICTION, PRESSURE, k_n=K_N, k_t=K_T, **ELLIPSE),
    "tresca, elliptic polygon": fc.Tresca(FRICTION, PRESSURE, k_n=K_N, k_t=K_T, modes=4, **ELLIPSE),
}
ALL_LAWS = LAWS | LAWS_3D


@dataclass(frozen=True)
class State:
    """Normal and tangential displacement, and optionally those of the last commit."""

    name: str
    normal: float
    tangential: float
    committed: tuple[float, float] | None = None


# The gap is 0.1 to 0.14 and the polynomial part about 0.01: δ₋ is 0.05 to 0.11 where closed, the
# friction limit 1.5 to 3.3 (Coulomb) or 2.7 (Tresca), that is 0.025 to 0.055 of elastic slip.
STATES = [
    State("open", -0.2, 0.004),
    State("stick", 0.2, 0.004),
    State("slip", 0.2, 0.3),
    # Traction of the last commit: 60 * 0.012 = 0.7; then reversed, to stick or slip.
    State("stick with history", 0.2, -0.006, (0.2, 0.012)),
    State("slip with history", 0.2, -0.3, (0.2, 0.012)),
    # Committed while slipping, so that β and a traction on the cone are in the history.
    State("stick after slip", 0.2, 0.29, (0.2, 0.3)),
    State("open after slip", -0.2, 0.29, (0.2, 0.3)),
]


class Scene:
    """Contact of two sides of a shuffled mesh with an oblique obstacle, for one law."""

    def __init__(self, cell: str, degree: int, law: fc.Law) -> None:
        """Create the contact with u = 0."""
        self.d = dimension(cell)
        self.degree = degree
        mesh, tags = block_mesh(cell, shuffled=True)
        self.space = displacement_space(mesh, degree)
        self.u = fem.Function(self.space)
        surface = fc.ContactSurface(mesh, tags, [BOTTOM, RIGHT])
        x = ufl.SpatialCoordinate(mesh)
        obstacle = fc.PrescribedGap(0.1 + 0.04 * x[0], NORMAL[self.d])
        self.contact = fc.Contact(self.u, surface, obstacle, law)

    def set_displacement(self, normal: float, tangential: float, seed: int) -> None:
        """Set u to mean normal and tangential displacements plus a small polynomial."""
        n = NORMAL[self.d] / np.linalg.norm(NORMAL[self.d])
        t = np.linalg.svd(n[None])[2][1]
        t *= np.sign(t[0])  # the sign of a null vector is not defined
        mean = normal * n + tangential * t
        field = polynomial(self.d, self.degree, seed, 0.002)
        self.u.interpolate(lambda x: mean[:, None] + field(x))

    def enter(self, state: State) -> None:
        """Bring every point into the given state, and check it."""
        self.contact.history.function.x.array[:] = 0.0
        if state.committed is not None:
            self.set_displacement(*state.committed, seed=1)
            self.contact.commit()
        self.set_displacement(state.normal, state.tangential, seed=2)
        self.contact.evaluate()
        contact = self.contact
        kind = state.name.split()[0]
        opened = gather(COMM, contact.gap > 0)
        assert np.all(opened) if kind == "open" else not np.any(opened)
        if contact.law.has_friction and kind != "open":
            slips = gather(COMM, np.any(contact.slip_increment > 0, axis=1))
            assert np.all(slips) if kind == "slip" else not np.any(slips)


def central_difference(scene: Scene, direction: np.ndarray, evaluate, h: float = 1e-5):
    """Return the central difference of ``evaluate()`` at u along a direction."""
    at = owned_values(scene.u).copy()
    ends = []
    for sign in (1, -1):
        set_owned(scene.u, at + sign * h * direction)
        ends.append(evaluate())
    set_owned(scene.u, at)
    return (ends[0] - ends[1]) / (2 * h)


def directions(scene: Scene) -> list[np.ndarray]:
    vectors = []
    for seed in (11, 12):
        f = fem.Function(scene.space)
        f.interpolate(rough_field(scene.d, seed))
        vectors.append(owned_values(f).copy())
    return vectors


@pytest.mark.each
@pytest.mark.parametrize(
    ("cell", "degree", "law"),
    [
        (cell, degree, law)
        for cell, degree in GRID
        # A law acts on points: one degree suffices for laws of 3D only.
        for law in (LAWS if dimension(cell) == 2 or degree > 1 else ALL_LAWS)
    ],
)
def test_residual_and_tangent_are_derivatives(cell, degree, law):
    """Central differences show δΠ = residual and δ(residual) = tangent in every state.

    Tolerance 1e-6: with h = 1e-5 and states of size 0.1 the truncation error is h²/0.1² = 1e-8
    where the law is curved (the cone) and zero elsewhere; round-off is 1e-16/h = 1e-11.
    """
    scene = Scene(cell, degree, ALL_LAWS[law])
    contact, space = scene.contact, scene.space
    v, du = ufl.TestFunction(space), ufl.TrialFunction(space)
    residual = compile_with_maps(contact.form(v), contact)
    tangent_form = compile_with_maps(contact.tangent(v, du), contact)
    potential = None
    kind = type(contact.law).__name__
    path_dependent = law.startswith(("coulomb", "compliance")) or law == "foundation, closed only"
    assert contact.law.has_potential is not path_dependent
    if not contact.law.has_potential:
        assert_raised_on_all_ranks(contact.potential, ValueError, kind, "potential")
    else:
        potential = compile_with_maps(contact.potential(), contact)
    for state in STATES:
        scene.enter(state)
        tangent = assemble_matrix(tangent_form)
        r = assemble_owned(residual, space)
        x, y = tangent.createVecs()
        for direction in directions(scene):
            if potential is not None:
                difference = central_difference(
                    scene, direction, lambda: assemble_scalar(potential, COMM)
                )
                exact = COMM.allreduce(float(r @ direction))
                # Relative to the sum of the magnitudes of all terms of the work.
                size = COMM.allreduce(float(np.abs(r * direction).sum()))
                assert abs(difference - exact) <= 1e-6 * size, state.name
            x.array[:] = direction
            tangent.mult(x, y)
            difference = central_difference(
                scene, direction, lambda: assemble_owned(residual, space)
            )
            difference, exact = gather(COMM, difference), gather(COMM, y.array)
            # Where the tangent vanishes, the round-off of the residual divided by h remains.
            assert is_close(difference, exact, 1e-6, scale=max(np.abs(exact).max(), 1e-4)), (
                state.name
            )
        check_shape(scene, state, law, gather(COMM, r), tangent)
        for thing in (tangent, x, y):
            thing.destroy()


def check_shape(scene: Scene, state: State, law: str, r: np.ndarray, tangent: PETSc.Mat) -> None:
    """Check what is zero and what is symmetric: 0 = 0 would pass as a derivative."""
    kind = state.name.split()[0]
    size = tangent.norm(PETSc.NormType.FROBENIUS)
    unilateral = law.startswith(("frictionless", "coulomb", "compliance"))
    unilateral = unilateral or law == "foundation, closed only"
    if kind == "open" and unilateral:
        assert np.all(r == 0.0) and size == 0.0, state.name
        return
    assert np.abs(r).max() > 1e-3, state.name
    if law == "prescribed" and kind == "slip" and scene.d == 2:
        # Both the tangential and the normal traction are constant.
        assert size <= 1e-12 * K_N
        return
    assert size > 1.0, state.name
    transposed = tangent.transpose(PETSc.Mat())
    transposed.axpy(-1.0, tangent)
    skew = transposed.norm(PETSc.NormType.FROBENIUS) / size
    transposed.destroy()
    if law.startswith(("coulomb", "compliance")) and kind == "slip":
        assert skew > 1e-2, state.name
    else:
        assert skew <= 1e-13, state.name


@pytest.mark.each
@pytest.mark.parametrize(
    ("cell", "law"),
    [(cell, law) for cell in CELLS for law in ("coulomb", "foundation")]
    + [("tetrahedron", "coulomb, ellipse"), ("hexahedron", "coulomb, polygon")],
)
def test_full_contact_springs_equal_the_sticking_tangent(cell, law):
    """The springs with full stiffness equal the consistent tangent where all points stick.

    Tolerance 1e-13: round-off of the same products summed in a different order.
    """
    scene = Scene(cell, 1, ALL_LAWS[law])
    scene.enter(STATES[1])
    assert set(gather(COMM, scene.contact.status).tolist()) == {fc.Status.STICK}
    v, du = ufl.TestFunction(scene.space), ufl.TrialFunction(scene.space)
    tangent = assemble_matrix(compile_with_maps(scene.contact.tangent(v, du), scene.contact))
    scene.contact.evaluate()
    stiffness = fc.ContactOperator(scene.contact).springs(scene.contact.values.springs(1.0, 1.0))
    size = tangent.norm()
    stiffness.axpy(-1.0, tangent, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    assert size > 1.0 and stiffness.norm() <= 1e-13 * size
    for matrix in (tangent, stiffness):
        matrix.destroy()


# ---- parameters ----------------------------------------------------------------------------------


def traction_by_hand(scene: Scene, mu, k_n, k_t) -> np.ndarray:
    """Return the tractions of a return map without history, in numpy, at all points."""
    x = gather(COMM, scene.contact.points)
    field = polynomial(scene.d, scene.degree, 2, 0.002)
    n = NORMAL[scene.d] / np.linalg.norm(NORMAL[scene.d])
    t = np.linalg.svd(n[None])[2][1]
    u = 0.2 * n + 0.03 * np.sign(t[0]) * t + field(x.T).T
    u_n = u @ n
    r_n = -k_n(x) * np.maximum(u_n - 0.1 - 0.04 * x[:, 0], 0)
    trial = -k_t(x)[:, None] * (u - np.outer(u_n, n))
    size = np.linalg.norm(trial, axis=1)
    tau = trial * np.minimum(1.0, -mu(x) * r_n / size)[:, None]
    return np.outer(r_n, n) + tau


@pytest.mark.parametrize("cell", CELLS)
def test_parameters_vary_over_the_surface(cell):
    """With μ, k_n and k_t as UFL of x, tractions are the return map with the values at each point.

    Reference: numpy. Tolerance 1e-12: round-off of some ten operations on each point.
    """
    scene = Scene(cell, 1, LAWS["frictionless"])
    mesh = scene.space.mesh
    x = ufl.SpatialCoordinate(mesh)
    law = fc.Coulomb(0.2 + 0.3 * x[0] ** 2, k_n=80 + 40 * x[1], k_t=ufl.exp(4 + x[0] * x[1]))
    surface, obstacle = scene.contact.surface, scene.contact.obstacle
    scene.contact = fc.Contact(scene.u, surface, obstacle, law)
    scene.set_displacement(0.2, 0.03, seed=2)
    scene.contact.evaluate()
    expected = traction_by_hand(
        scene,
        lambda x: 0.2 + 0.3 * x[:, 0] ** 2,
        lambda x: 80 + 40 * x[:, 1],
        lambda x: np.exp(4 + x[:, 0] * x[:, 1]),
    )
    status = set(gather(COMM, scene.contact.status).tolist())
    assert status == {fc.Status.STICK, fc.Status.SLIP}
    assert is_close(gather(COMM, scene.contact.traction), expected, 1e-12)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_parameters_change_without_compiling(cell, monkeypatch):
    """``contact.parameters[name].value`` changes values, form and tangent without compilation.

    Reference: numpy, to 1e-12 (round-off); of the tangents only that their norms differ.
    """
    scene = Scene(cell, 1, LAWS["coulomb"])
    contact, space = scene.contact, scene.space
    assert {"friction", "k_n", "k_t"} <= set(contact.parameters)
    v, du = ufl.TestFunction(space), ufl.TrialFunction(space)
    form = compile_with_maps(contact.form(v), contact)
    tangent = compile_with_maps(contact.tangent(v, du), contact)

    def refuse(*args, **kwargs):
        raise AssertionError("a form was compiled")

    monkeypatch.setattr(dolfinx.jit, "ffcx_jit", refuse)
    # The guard works: compiling a new form fails.
    with pytest.raises(AssertionError, match="compiled"):
        fem.form(contact.form(v), entity_maps=contact.entity_maps)
    scene.set_displacement(0.2, 0.03, seed=2)
    sizes = []
    for mu, k_n, k_t in ((FRICTION, K_N, K_T), (0.1, 2 * K_N, 3 * K_T), (0.0, 50.0, 40.0)):
        for name, value in zip(("friction", "k_n", "k_t"), (mu, k_n, k_t), strict=True):
            contact.parameters[name].value = value
        contact.evaluate()
        expected = traction_by_hand(
            scene,
            lambda x, mu=mu: np.full(len(x), mu),
            lambda x, k_n=k_n: np.full(len(x), k_n),
            lambda x, k_t=k_t: np.full(len(x), k_t),
        )
        assert is_close(gather(COMM, contact.traction), expected, 1e-12)
        # The assembled form sums minus the traction over Γc.
        measure = gather(COMM, contact.measure)
        force = COMM.allreduce(assemble_owned(form, space).reshape(-1, scene.d).sum(axis=0))
        assert is_close(-force, measure @ expected, 1e-12)
        matrix = assemble_matrix(tangent)
        sizes.append(matrix.norm())
        matrix.destroy()
    assert len(set(np.round(sizes, 6))) == 3


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_weight_multiplies_the_form_and_the_resultants(cell):
    """``weight`` multiplies form, potential and resultants, and leaves tractions unchanged.

    Reference: the same contact with weight one; a weight of 2.5 is exact to round-off, 1e-13.
    """
    plain = Scene(cell, 1, LAWS["tresca"])
    contacts = [plain.contact]
    contacts.append(
        fc.Contact(
            plain.u, plain.contact.surface, plain.contact.obstacle, LAWS["tresca"], weight=2.5
        )
    )
    plain.set_displacement(0.2, 0.3, seed=2)
    v = ufl.TestFunction(plain.space)
    forces, energies, tractions, resultants = [], [], [], []
    for contact in contacts:
        contact.evaluate()
        forces.append(
            gather(COMM, assemble_owned(compile_with_maps(contact.form(v), contact), plain.space))
        )
        energies.append(assemble_scalar(compile_with_maps(contact.potential(), contact), COMM))
        tractions.append(gather(COMM, contact.traction))
        resultants.append(contact.resultants())
    assert is_close(forces[1], 2.5 * forces[0], 1e-13)
    assert abs(energies[1] - 2.5 * energies[0]) <= 1e-13 * energies[1]
    assert is_close(tractions[1], tractions[0], 1e-13)
    assert is_close(resultants[1].force, 2.5 * resultants[0].force, 1e-13)
    assert resultants[1].normal_force == pytest.approx(2.5 * resultants[0].normal_force, rel=1e-13)
    assert resultants[1].max_pressure == pytest.approx(resultants[0].max_pressure, rel=1e-13)


@pytest.mark.parametrize("cell", CELLS)
def test_scaled_stiffness_is_a_multiple_of_modulus_over_height(cell):
    """`RelativeStiffness` with a given modulus gives k_n = factor E/h, cell height h = 1/3.

    Tolerance 1e-9: the E/h field is smoothed by an iterative solve (1e-14) of its logarithm.
    """
    d = dimension(cell)
    mesh, tags = block_mesh(cell, n=3)
    u = fem.Function(displacement_space(mesh, 1))
    surface = fc.ContactSurface(mesh, tags, BOTTOM)
    law = fc.Frictionless(k_n=fc.RelativeStiffness(3.0))
    up = np.eye(d)[-1]
    contact = fc.Contact(u, surface, fc.HalfSpace(0 * up, up), law, modulus=210.0)
    u.interpolate(lambda x: np.outer(-0.01 * up, np.ones(x.shape[1])))
    contact.evaluate()
    pressure = gather(COMM, contact.pressure)
    assert is_close(pressure, np.full(len(pressure), 3.0 * 210.0 * 3 * 0.01), 1e-9)
    contact.parameters["k_n"].value = 6.0  # the factor
    contact.evaluate()
    assert is_close(gather(COMM, contact.pressure), 2 * pressure, 1e-9)
