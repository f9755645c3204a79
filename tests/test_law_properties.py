"""Properties of all contact laws for any numbers, by hypothesis over twenty orders of magnitude.

The laws are compiled and evaluated as in a contact, at one point whose kinematics and parameters
are coefficients. All references are computed by numpy.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
import ufl
from dolfinx import fem
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.laws.base import Law, PointKinematics
from fenics_contact.laws.friction import FrictionLaw
from fenics_contact.surface.surface import PointEvaluator
from scenes.blocks import BOTTOM, block_mesh

pytestmark = [pytest.mark.mpi, pytest.mark.timeout(200)]
COMM = MPI.COMM_WORLD

# The values in the constructors are irrelevant: every parameter is an argument of the point.
AXES = {"transverse_friction": 1.0, "direction": (1, 0, 0)}
PLANE = {
    "frictionless": fc.Frictionless(1.0),
    "foundation": fc.Foundation(1.0, 1.0),
    "foundation, closed only": fc.Foundation(1.0, 1.0, tension=False),
    "coulomb": fc.Coulomb(1.0),
    "tresca": fc.Tresca(1.0, 1.0),
    "prescribed": fc.Tresca(1.0, 1.0, unilateral=False),
}
SPACE = PLANE | {
    "triangle": fc.Coulomb(1.0, modes=3, direction=(1, 0, 0)),
    "square": fc.Tresca(1.0, 1.0, modes=4, direction=(1, 0, 0)),
    "pentagon": fc.Coulomb(1.0, modes=5, direction=(1, 0, 0)),
    "octagon": fc.Tresca(1.0, 1.0, modes=8, direction=(1, 0, 0)),
    "ellipse": fc.Coulomb(1.0, **AXES),
    "prescribed ellipse": fc.Tresca(1.0, 1.0, unilateral=False, **AXES),
    "elliptic triangle": fc.Tresca(1.0, 1.0, modes=3, **AXES),
    "free polygon": fc.Coulomb(1.0, modes=6),
}
ALL = [(name, 2) for name in PLANE] + [(name, 3) for name in SPACE]
FRICTION = [(n, d) for n, d in ALL if isinstance(SPACE[n], FrictionLaw)]
UNILATERAL = [(n, d) for n, d in ALL if n not in ("foundation", "prescribed", "prescribed ellipse")]

properties = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=100,
    suppress_health_check=[HealthCheck.too_slow],
)
# Rounding of some twenty operations, relative to the largest number among them.
EXACT = 1e-13


class Point:
    """A law at one point, with coefficients as arguments."""

    def __init__(self, law: Law, d: int) -> None:
        """Compile the law."""
        mesh, tags = block_mesh(
            "quadrilateral" if d == 2 else "hexahedron", n=1, comm=MPI.COMM_SELF
        )
        quadrature = fc.ContactSurface(mesh, tags, BOTTOM, quadrature_degree=2).quadrature(1)
        shapes = {"gap": 0, "u_n": 0, "n": d, "u_t": d, "moved": d, "old": d}
        shapes |= {name: 3 if name == "direction" else 0 for name in law.parameters()}
        self.slices, size = {}, 0
        for name, shape in shapes.items():
            self.slices[name] = slice(size, size + max(shape, 1))
            size += max(shape, 1)
        self.arguments, self.size = fem.Function(quadrature.space(size)), size

        def argument(name: str):
            entries = [self.arguments[i] for i in range(size)[self.slices[name]]]
            return ufl.as_vector(entries) if shapes[name] else entries[0]

        kinematics = PointKinematics(
            argument("gap") - argument("u_n"),
            *(argument(n) for n in ("n", "u_t", "moved", "old")),
        )
        parameters = {name: argument(name) for name in law.parameters()}
        response = law.contact_traction(kinematics, parameters)
        expressions = {"r_n": response.normal_traction}
        expressions["stored"] = law.stored(kinematics, response, parameters)
        self.modes = 0
        if law.has_tangential:
            stiffness = law.tangential_stiffness(kinematics, parameters)
            expressions |= {"tau": response.traction}
            expressions |= {f"K {i}": stiffness[i, :] for i in range(d)}
        if law.has_friction:
            traction = ufl.variable(response.traction)
            functions = law.yield_functions(
                kinematics, traction, response.friction_bound, parameters
            )
            expressions["circumradius"] = law.circumradius(parameters)
            expressions |= {"limit": response.friction_bound, "slip": ufl.as_vector(response.slip)}
            expressions["functions"] = ufl.as_vector(functions)
            expressions["dissipated"] = law.dissipated(kinematics, response, parameters)
            self.modes = len(functions)
            for j, g in enumerate(functions):
                expressions[f"gradient {j}"] = ufl.diff(g, traction)
        self.evaluate = PointEvaluator(quadrature, expressions)

    def __call__(self, arguments: dict) -> dict:
        """Return the fields of the law by name, for arguments by name."""
        for name, place in self.slices.items():
            self.arguments.x.array.reshape(-1, self.size)[:, place] = arguments[name]
        fields = {name: value[0] for name, value in self.evaluate().items()}
        for name, keys in (
            ("gradients", [f"gradient {j}" for j in range(self.modes)]),
            ("K", [name for name in fields if name.startswith("K ")]),
        ):
            if keys:
                fields[name] = np.array([fields.pop(key) for key in keys])
        return fields


@functools.cache
def point(name: str, d: int) -> Point:
    """Return the law of this name; ranks compile it one after another, as they share a cache."""
    created = None
    for rank in range(COMM.size):
        if rank == COMM.rank:
            created = Point(SPACE[name], d)
        COMM.barrier()
    return created


# ---- arguments -----------------------------------------------------------------------------------

powers = st.floats(-10, 10).map(lambda e: 10.0**e)
sizes = st.one_of(st.just(0.0), powers)
signed = st.builds(lambda size, sign: sign * size, sizes, st.sampled_from([1.0, -1.0]))
angles = st.floats(0, 6.25)


@st.composite
def unit_vectors(draw, d: int):
    if d == 2:
        a = draw(angles)
        return np.array([np.cos(a), np.sin(a)])
    z, a = draw(st.floats(-1, 1)), draw(angles)
    r = np.sqrt(1 - z * z)
    return np.array([r * np.cos(a), r * np.sin(a), z])


def frame(n: np.ndarray) -> np.ndarray:
    """Return orthonormal tangent vectors, (d - 1, d)."""
    if len(n) == 2:
        return np.array([[-n[1], n[0]]])
    first = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(n, first)])


@st.composite
def tangents(draw, n: np.ndarray, lengths=sizes):
    length = draw(lengths)
    if len(n) == 2:
        return draw(st.sampled_from([1.0, -1.0])) * length * frame(n)[0]
    a = draw(angles)
    return length * np.array([np.cos(a), np.sin(a)]) @ frame(n)


@st.composite
def arguments(draw, name: str, d: int, *, closed: bool = False):
    """Draw arguments of a law; ``closed``: with a closed gap."""
    n = draw(unit_vectors(d))
    drawn = {"n": n, "gap": draw(signed), "u_n": draw(signed)}
    if closed:
        drawn["u_n"] = drawn["gap"] + draw(powers)
        assume(drawn["u_n"] > drawn["gap"])
    for key in ("u_t", "moved", "old"):
        drawn[key] = draw(tangents(n))
    for key in SPACE[name].parameters():
        if key == "direction":
            drawn[key] = draw(tangents(n, powers)) + draw(signed.filter(lambda x: abs(x) < 3)) * n
            across = drawn[key] - (drawn[key] @ n) * n
            assume(np.linalg.norm(across) > 0.1 * np.linalg.norm(drawn[key]))
        elif key == "transverse_friction":
            continue
        else:
            drawn[key] = draw(powers if key[:2] == "k_" or name.endswith("ellipse") else sizes)
    if "transverse_friction" in SPACE[name].parameters():
        drawn["friction"] = draw(powers)
        # Beyond this ratio the scaling itself loses the digits that are tested.
        drawn["transverse_friction"] = drawn["friction"] * 10 ** draw(st.floats(-2, 2))
    return drawn


# ---- references ----------------------------------------------------------------------------------


def ratio(a: dict) -> float:
    return a["transverse_friction"] / a["friction"] if "transverse_friction" in a else 1.0


def loss(a: dict) -> float:
    """Return the factor by which the scaling across the direction amplifies round-off."""
    return max(ratio(a), 1 / ratio(a))


def axes(a: dict) -> np.ndarray:
    """Return the tangents along the direction (by default x, else y) and across it, (2, 3)."""
    direction = a.get("direction", [1.0, 0, 0] if abs(a["n"][0]) < 0.9 else [0, 1.0, 0])
    first = direction - (direction @ a["n"]) * a["n"]
    first = first / np.linalg.norm(first)
    return np.array([first, np.cross(a["n"], first)])


def stiffness(a: dict) -> np.ndarray:
    """Return K_t plus k_t along the normal, so that it has an inverse."""
    n = a["n"]
    if "transverse_friction" in a:
        first, second = axes(a)
        tangential = np.outer(first, first) + ratio(a) ** 2 * np.outer(second, second)
    else:
        tangential = np.eye(len(n)) - np.outer(n, n)
    return a["k_t"] * (tangential + np.outer(n, n))


def trial(a: dict) -> np.ndarray:
    """Return τ* (44)."""
    return a["old"] - stiffness(a) @ a["moved"]


def size(a: dict) -> float:
    """Return the magnitude of the terms of the traction."""
    return np.linalg.norm(a["old"]) + np.linalg.norm(stiffness(a) @ a["moved"])


def corners(name: str, a: dict) -> np.ndarray:
    """Return all corners of the yield surface of bound one, or many points on it, (n, d)."""
    law = SPACE[name]
    if len(a["n"]) == 2:
        return np.concatenate([frame(a["n"]), -frame(a["n"])])
    if law.modes is None:
        around, radius = np.linspace(0, 2 * np.pi, 721), 1.0
    else:
        around = (2 * np.arange(law.modes) + 1) * np.pi / law.modes
        radius = 1 / np.cos(np.pi / law.modes)
    first, second = axes(a)
    return radius * (np.outer(np.cos(around), first) + ratio(a) * np.outer(np.sin(around), second))


def gauge(name: str, a: dict, tau: np.ndarray) -> float:
    """Return the friction bound on whose yield surface τ lies."""
    law = SPACE[name]
    if len(tau) == 2:
        return abs(tau @ frame(a["n"])[0])
    sigma = axes(a) @ tau / [1.0, ratio(a)]
    if law.modes is None:
        return np.linalg.norm(sigma)
    around = 2 * np.arange(law.modes) * np.pi / law.modes
    return max(np.cos(around) * sigma[0] + np.sin(around) * sigma[1])


# ---- the normal law ------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "d"), UNILATERAL)
@properties
@given(data=st.data())
def test_complementarity(name, d, data):
    """Eq. (3-11) hold: no adhesion, r_n δ₊ = 0 without rounding, open points are free."""
    a = data.draw(arguments(name, d))
    r = point(name, d)(a)
    gap = a["gap"] - a["u_n"]
    assert r["r_n"] <= 0
    assert gap <= 0 or r["r_n"] == 0
    assert abs(r["r_n"] + a["k_n"] * max(-gap, 0.0)) <= EXACT * abs(r["r_n"])
    law = SPACE[name]
    if gap >= 0 and not isinstance(law, fc.Tresca) and law.has_tangential:
        assert np.all(r["tau"] == 0)
        assert not law.has_friction or np.all(r["slip"] == 0)


@pytest.mark.parametrize(("name", "d"), ALL)
@properties
@given(data=st.data())
def test_normal_law_is_monotone(name, d, data):
    """Pressure never decreases with the displacement towards the obstacle: exactly."""
    a = data.draw(arguments(name, d))
    b = a | {"u_n": data.draw(signed)}
    low, high = sorted((a, b), key=lambda x: x["u_n"])
    pressure = [-point(name, d)(x)["r_n"] for x in (low, high)]
    assert pressure[0] <= pressure[1]


@pytest.mark.parametrize("name", ["foundation", "foundation, closed only"])
@pytest.mark.parametrize("d", [2, 3])
@properties
@given(data=st.data())
def test_foundation(name, d, data):
    """r_n = -k_n (u_n - s) and τ = -k_t u_t, with or without tension, for any history."""
    a = data.draw(arguments(name, d))
    r = point(name, d)(a)
    acts = name == "foundation" or a["u_n"] > a["gap"]
    normal = a["k_n"] * (a["gap"] - a["u_n"]) if acts else 0.0
    tangential = -a["k_t"] * a["u_t"] if acts else 0 * a["u_t"]
    assert abs(r["r_n"] - normal) <= EXACT * abs(normal)
    # Products below the smallest normal number have larger rounding errors.
    assert np.all(
        np.abs(r["tau"] - tangential) <= EXACT * np.abs(tangential) + np.finfo(float).tiny
    )


# ---- the tangential law --------------------------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize(("name", "d"), FRICTION)
@properties
@given(data=st.data())
def test_cone_and_flow(name, d, data):
    """Eq. (44): g ≤ 0, Δβ ≥ 0, Δβ_j g_j = 0, Δτ = -K_t (Δu_t + Σ Δβ_j ∂g_j/∂τ).

    The friction bound is μ p; the yield surface and K_t are those computed by numpy.
    """
    a = data.draw(arguments(name, d, closed=True))
    r = point(name, d)(a)
    limit, beta, g, tau = r["limit"], r["slip"], r["functions"], r["tau"]
    expected = a["friction"] * a.get("pressure", -r["r_n"])
    assert abs(limit - expected) <= EXACT * expected
    exact = EXACT * loss(a)
    assert gauge(name, a, tau) <= (1 + exact) * limit
    # If τ* is a small difference of large terms, their rounding dominates.
    adherence = gauge(name, a, trial(a))
    rounding = exact * size(a) * (limit / adherence if adherence > limit else 1.0)
    assert abs(g.max() + limit - gauge(name, a, tau)) <= exact * limit + rounding
    assert np.linalg.norm(corners(name, a), axis=1).max() <= (1 + exact) * r["circumradius"]
    assert abs(tau @ a["n"]) <= rounding
    along = np.outer(a["n"], a["n"])
    difference = r["K"] + a["k_t"] * along - stiffness(a)
    assert np.abs(difference).max() <= exact * np.abs(r["K"]).max()
    assert beta.min() >= 0
    excess = a["k_t"] * beta.max()
    assert np.all(a["k_t"] * beta * np.abs(g) <= exact * limit * max(excess, limit))
    returned = trial(a) - tau
    if limit > 0:  # a yield surface of zero size has no normal
        flow = stiffness(a) @ (beta @ r["gradients"])
        assert np.abs(returned - flow).max() <= exact * size(a)


@pytest.mark.parametrize(("name", "d"), FRICTION)
@properties
@given(data=st.data())
def test_traction_is_the_closest_point(name, d, data):
    """The traction is the point closest to τ* in the metric of K_t, and slip dissipates energy.

    The closest point of a convex set satisfies (τ* - τ)·K_t⁻¹ (s - τ) ≤ 0 for all s of the set; for
    s = 0 this is the dissipation -τ·(Δu_t + K_t⁻¹ Δτ) ≥ 0.
    """
    a = data.draw(arguments(name, d, closed=True))
    r = point(name, d)(a)
    tau = r["tau"]
    slipped = np.linalg.solve(stiffness(a), trial(a) - tau)
    rounding = EXACT * loss(a) * np.linalg.norm(np.linalg.solve(stiffness(a), np.eye(d)), 2)
    rounding *= size(a) * max(np.linalg.norm(tau), r["limit"])
    assert tau @ slipped >= -rounding
    others = r["limit"] * corners(name, a)
    assert np.max(others @ slipped) <= tau @ slipped + 10 * rounding


@pytest.mark.each
@pytest.mark.parametrize(("name", "d"), ALL)
@properties
@given(data=st.data())
def test_stored_and_dissipated_energy(name, d, data):
    """½ k_n δ² and ½ τ·K_t⁻¹ τ are stored, never negative; the work of slip is dissipated (44)."""
    a = data.draw(arguments(name, d, closed=True))
    r = point(name, d)(a)
    law = SPACE[name]
    penetration = max(a["u_n"] - a["gap"], 0.0)
    expected = a["k_n"] / 2 * penetration**2 if law.has_normal_stiffness else 0.0
    if law.has_tangential:
        expected += r["tau"] @ np.linalg.solve(stiffness(a), r["tau"]) / 2
    # Across the direction the metric contains the square of the scaling.
    exact = 10 * EXACT * loss(a) ** 2
    assert abs(r["stored"] - expected) <= exact * expected and r["stored"] >= 0
    if law.has_friction:
        slipped = np.linalg.solve(stiffness(a), trial(a) - r["tau"])
        scale = size(a) * np.linalg.norm(np.linalg.solve(stiffness(a), np.eye(d)), 2)
        assert abs(r["dissipated"] - r["tau"] @ slipped) <= exact * scale * np.linalg.norm(r["tau"])


@pytest.mark.parametrize("sides", [3, 4, 5, 8])
@properties
@given(data=st.data())
def test_polygon_by_brute_force(sides, data):
    """The closed form equals the nearest of the closest points of all sides, searched in numpy."""
    name = {3: "triangle", 4: "square", 5: "pentagon", 8: "octagon"}[sides]
    a = data.draw(arguments(name, 3, closed=True))
    r = point(name, 3)(a)
    start = trial(a)
    expected = start
    if gauge(name, a, start) > r["limit"]:
        ends = r["limit"] * corners(name, a)
        candidates = []
        for p, q in zip(ends, np.roll(ends, -1, axis=0), strict=True):
            length = (q - p) @ (q - p)
            fraction = np.clip((start - p) @ (q - p) / length, 0, 1) if length > 0 else 0.0
            candidates.append(p + fraction * (q - p))
        expected = min(candidates, key=lambda c: np.linalg.norm(start - c))
    # The position along a side follows from τ*, with its rounding.
    assert np.abs(r["tau"] - expected).max() <= EXACT * size(a)


def test_polygon_has_all_cases():
    """Tractions in all directions stick, or lie on one side, or at a vertex (two modes)."""
    law = point("pentagon", 3)
    active = set()
    for turn in np.linspace(0, 6.2, 50):
        for length in (0.5, 1.3, 4.0):
            moved = length * np.array([np.cos(turn), np.sin(turn), 0.0])
            a = {"n": [0, 0, 1.0], "gap": 0, "u_n": 1, "u_t": 0, "moved": moved, "old": 0}
            a |= {"friction": 1, "k_n": 1, "k_t": 1, "direction": [1.0, 0.2, 0]}
            active.add(int(np.count_nonzero(law(a)["slip"])))
    assert active == {0, 1, 2}


@pytest.mark.parametrize(("name", "d"), FRICTION)
@properties
@given(data=st.data())
def test_traction_is_monotone(name, d, data):
    """(τ - τ')·(Δu_t - Δu_t') ≤ 0 at equal bound, and in magnitude at most that of stick."""
    a = data.draw(arguments(name, d, closed=True))
    b = a | {"moved": data.draw(tangents(a["n"]))}
    difference = point(name, d)(a)["tau"] - point(name, d)(b)["tau"]
    moved = a["moved"] - b["moved"]
    rounding = EXACT * loss(a) * (size(a) + size(b)) * np.linalg.norm(moved)
    assert difference @ moved <= rounding
    assert -difference @ moved <= moved @ stiffness(a) @ moved + rounding


# ---- symmetries ----------------------------------------------------------------------------------

# The frame of a polygon without direction depends on the coordinate axes.
SCENES = [(name, d) for name, d in ALL if name != "free polygon"]


def moved_rigidly(a: dict, q: np.ndarray) -> dict:
    """Return the arguments, rotated or mirrored by q."""
    return {name: q @ value if np.ndim(value) else value for name, value in a.items()}


def same_scene(name: str, a: dict, b: dict, q: np.ndarray, order: np.ndarray) -> None:
    """Check that the law's result for b is that for a, transformed by q, with modes reordered."""
    d = len(a["n"])
    one, other = point(name, d)(a), point(name, d)(b)
    assert other["r_n"] == one["r_n"]
    if not SPACE[name].has_tangential:
        return
    rounding = EXACT * loss(a) * (size(a) + a["k_t"] * np.linalg.norm(a["u_t"]))
    assert np.abs(other["tau"] - q @ one["tau"]).max() <= rounding
    if SPACE[name].has_friction:
        assert np.abs(other["slip"] - one["slip"][order]).max() * a["k_t"] <= rounding


def modes(name: str, d: int, *, mirrored: bool) -> np.ndarray:
    law = SPACE[name]
    n = law.n_modes(d)
    if not mirrored or n == 1:
        return np.arange(n)
    return np.array([1, 0]) if d == 2 else -np.arange(n) % n


def rotation(axis: np.ndarray, angle: float, d: int) -> np.ndarray:
    """Return the rotation matrix, in 3D by Rodrigues' formula."""
    if d == 2:
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cross = np.cross(np.eye(3), -axis)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.mark.parametrize(("name", "d"), SCENES)
@properties
@given(data=st.data())
def test_objectivity(name, d, data):
    """The traction rotates with the scene; everything else is unchanged."""
    a = data.draw(arguments(name, d))
    q = rotation(data.draw(unit_vectors(d)), data.draw(angles), d)
    assert np.allclose(q @ q.T, np.eye(d), atol=1e-14) and np.linalg.det(q) > 0
    same_scene(name, a, moved_rigidly(a, q), q, modes(name, d, mirrored=False))


@pytest.mark.parametrize(("name", "d"), SCENES)
@properties
@given(data=st.data())
def test_reflection(name, d, data):
    """The traction is mirrored with the scene; the modes are exchanged with their images."""
    a = data.draw(arguments(name, d))
    m = data.draw(unit_vectors(d))
    q = np.eye(d) - 2 * np.outer(m, m)
    same_scene(name, a, moved_rigidly(a, q), q, modes(name, d, mirrored=True))
