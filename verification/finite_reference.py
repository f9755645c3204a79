"""The second solution with finite kinematics, and the judge that asks it.

What the package does by UFL, derivatives and compiled forms is made here from closed formulas at
points, in NumPy: distances and normals of every shape, frames that move and turn, slip, the
committed traction's turn by two reflections, the return map of `reference_solver`, rubber by its
stress. Shared are DOLFINx's assembly of the bulk, and the numbers of the scene. Derivatives of
tractions are differences; Newton's method with a line search goes from load to load in small steps,
the history kept from the start of the increment.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.interpolate
import scipy.linalg
import scipy.spatial.distance
import scipy.spatial.transform
import ufl
from dolfinx import fem
from mpi4py import MPI

from verification import finite_scenes, fuzz_judge, fuzz_models
from verification import reference_solver as reference
from verification.reference_geometry import Body
from verification.reference_solver import Failed

__all__ = [
    "FiniteContact",
    "FiniteJudge",
    "FiniteProblem",
    "bulk_of",
    "loads_of",
    "model",
    "rubber",
    "shape_of",
]

Array = np.ndarray
# Of a shape: signed distance, (n,), and minus its gradient, (n, d), at places (n, d).
Shape = Callable[[Array], tuple[Array, Array]]

# Steps of differences, by the size of the mesh: shorter than stiff springs give way.
_DIFFERENCE = 1e-8
# Parts into which an increment is cut, tried in turn; and softer springs to start from.
_PARTS = (4, 32)
_SOFTER = 10.0 ** np.arange(-5, 0.1, 0.5)
_ROUNDS = 400


# ---- shapes --------------------------------------------------------------------------------------


def shape_of(scene: dict[str, Any], contact: dict[str, Any]) -> Shape:
    """The shape of an obstacle by closed formulas, or by brute force over its data."""
    given, where = contact["obstacle"], finite_scenes.place_of(scene, contact)
    kind, d = given["kind"], len(scene["bodies"][0]["size"])
    if contact["side"] == "right" or kind == "halfspace":
        normal = where["normal"]
        return lambda x: ((x - where["point"]) @ normal, np.tile(-normal, (len(x), 1)))
    if kind.startswith(("ball", "cylinder")):
        keep = np.eye(d)
        if kind.startswith("cylinder") and d == 3:
            axis = np.array(given.get("axis", (0.0, 1.0, 0.0)))
            keep -= np.outer(axis, axis) / (axis @ axis)
        sign = -1.0 if kind.endswith("inside") else 1.0
        return lambda x: _from_point((x - where["center"]) @ keep, where["radius"], sign)
    if kind in ("capsule", "rod"):
        return lambda x: fuzz_models.capsule_at(x, where)
    if kind == "torus":
        centre = where["center"] - where["ring"] * np.eye(3)[0]

        def torus(x: Array) -> tuple[Array, Array]:
            arm = (x - centre) * [1.0, 1.0, 0.0]
            ring = where["ring"] * arm / np.linalg.norm(arm, axis=1)[:, None]
            return _from_point(x - centre - ring, where["radius"], 1.0)

        return torus
    if kind in ("facets", "box"):
        points, numbers = finite_scenes.pieces(scene, contact)
        return _convex(points[numbers])
    points, _ = finite_scenes.pieces(scene, contact)
    if kind == "turned profile":  # all the way round in the half-plane, its other half mirrored
        flat = (points - where["center"])[:, [0, 2]]
        loop = _loop(np.concatenate([flat, flat[-2:0:-1] * [-1.0, 1.0]]))

        def turned(x: Array) -> tuple[Array, Array]:
            arm = x - where["center"]
            out = np.hypot(arm[:, 0], arm[:, 1])
            distance, normal = loop(np.column_stack([out, arm[:, 2]]))
            way = arm[:, :2] / out[:, None]
            return distance, np.column_stack([normal[:, :1] * way, normal[:, 1]])

        return turned
    loop = _loop(points[:, [0, -1]])
    if d == 2:
        return loop

    def extruded(x: Array) -> tuple[Array, Array]:
        distance, normal = loop(x[:, [0, 2]])
        return distance, np.column_stack([normal[:, 0], np.zeros(len(x)), normal[:, 1]])

    return extruded


def _from_point(arm: Array, radius: float, sign: float) -> tuple[Array, Array]:
    far = np.sqrt(np.sum(arm * arm, axis=1))
    return sign * (far - radius), -sign * arm / far[:, None]


def _loop(points: Array) -> Shape:
    """A closed cubic spline through points, anticlockwise, over the length of the chords."""
    closed = np.vstack([points, points[:1]])
    knots = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1)))
    spline = scipy.interpolate.CubicSpline(knots, closed, bc_type="periodic")
    end = knots[-1]
    grid = np.linspace(0.0, end, 2000, endpoint=False)
    on = spline(grid)

    def sample(x: Array) -> tuple[Array, Array]:
        far = np.linalg.norm(x[:, None, :] - on[None], axis=2)
        best = far.argmin(axis=1)
        low, high = grid[best] - end / 2000, grid[best] + end / 2000
        for _ in range(60):  # bisection of the slope of the distance
            middle = 0.5 * (low + high)
            ahead = np.sum((x - spline(middle)) * spline(middle, 1), axis=1) > 0
            low, high = np.where(ahead, middle, low), np.where(ahead, high, middle)
        t = 0.5 * (low + high)
        along = spline(t, 1)
        out = np.column_stack([along[:, 1], -along[:, 0]]) / np.hypot(*along.T)[:, None]
        return np.sum((x - spline(t)) * out, axis=1), -out

    return sample


def _convex(corners: Array) -> Shape:
    """A convex polygon or polyhedron by its facets, (m, d, d), outwards."""
    d = corners.shape[2]
    if d == 2:
        edge = corners[:, 1] - corners[:, 0]
        out = np.column_stack([edge[:, 1], -edge[:, 0]])
    else:
        out = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = out / np.linalg.norm(out, axis=1)[:, None]

    def sample(x: Array) -> tuple[Array, Array]:
        n = np.arange(len(x))
        height = np.einsum("nmd,md->nm", x[:, None] - corners[None, :, 0], out)
        best = height.argmax(axis=1)
        distance, normal = height[n, best], -out[best]
        # Outside, the closest of all edges and corners, where no facet lies straight below.
        foot = x[:, None] - height[:, :, None] * out
        below = np.ones(height.shape, dtype=bool)
        arms = []
        for i in range(d if d == 3 else 1):
            a, b = corners[:, i], corners[:, (i + 1) % d]
            way = b - a
            if d == 3:
                side = np.cross(way[None], foot - a)
                below &= np.sum(side * out, axis=2) >= 0
            share = np.sum((x[:, None] - a) * way, axis=2) / np.sum(way * way, axis=1)
            if d == 2:
                below &= (share >= 0) & (share <= 1)
            near = a + np.clip(share, 0, 1)[:, :, None] * way
            arms.append(x[:, None] - near)
        arms = np.concatenate(arms, axis=1)
        far = np.linalg.norm(arms, axis=2)
        closest = far.argmin(axis=1)
        above = np.where(below & (height > 0), height, np.inf)
        facet = above.argmin(axis=1)
        outside = distance > 0
        flat = outside & (above[n, facet] <= far[n, closest])
        distance = np.where(outside, far[n, closest], distance)
        rounded = -arms[n, closest] / np.where(outside, far[n, closest], 1.0)[:, None]
        normal = np.where(outside[:, None], rounded, normal)
        distance = np.where(flat, above[n, facet], distance)
        normal = np.where(flat[:, None], -out[facet], normal)
        return distance, normal

    return sample


# ---- points --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pose:
    """Where an obstacle is: x = R (z - about) + about + shift, from places z where it began."""

    turn: Array
    about: Array
    shift: Array

    def into(self, x: Array) -> Array:
        """Places in the frame of the obstacle."""
        return (x - self.about - self.shift) @ self.turn + self.about

    def out(self, z: Array) -> Array:
        """Places in space."""
        return (z - self.about) @ self.turn.T + self.about + self.shift


@dataclass(eq=False)
class FiniteState(reference.State):
    """History of points; places and vectors in the frame of the obstacle.

    Attributes:
        jump: The closest point of the obstacle, (n, d) (length).
        traction: τ, or with multipliers λ_t.
        normal: n that it is across.
    """

    normal: Array | None = None


@dataclass(eq=False)
class FiniteContact(reference.ContactModel):
    """Γc on a rigid obstacle, at places X + u.

    Attributes:
        shape: Of the obstacle where it began.
        about: A point of the axis of its turn.
        axis: Direction of that in space; None in the plane.
        turns: Whether it turns.
    """

    shape: Any = None
    about: Any = None
    axis: Any = None
    turns: bool = False

    def pose(self, shift: Array, angle: float) -> Pose:
        """Where the obstacle is."""
        if not self.turns:
            return Pose(np.eye(self.d), np.zeros(self.d), shift)
        if self.d == 2:
            turn = scipy.spatial.transform.Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
            return Pose(turn[:2, :2], self.about, shift)
        along = angle * self.axis / np.linalg.norm(self.axis)
        turn = scipy.spatial.transform.Rotation.from_rotvec(along).as_matrix()
        return Pose(turn, self.about, shift)

    def spine_at(self, shift: Any) -> Array:
        """See `reference.ContactModel`."""
        return shift.out(self.spine)

    def start(self) -> FiniteState:
        """No traction, on the obstacle where it began."""
        distance, normal = self.shape(self.x)
        zero = np.zeros_like(self.x)
        pressure = None if self.project is None else np.zeros(len(zero))
        return FiniteState(self.x + distance[:, None] * normal, zero, pressure, None, normal)

    def respond(self, jump: Array, shift: Any, old: Any) -> dict[str, Array]:
        """Tractions and what they follow from; ``shift`` is a `Pose`."""
        pose, law = shift, self.law
        x = self.x + jump
        distance, inward = self.shape(pose.into(x))
        n = inward @ pose.turn.T
        foot = x + distance[:, None] * n

        def across(vector: Array) -> Array:
            return vector - np.sum(vector * n, axis=1)[:, None] * n

        step = across(foot - pose.out(old.jump))
        before = across(_turned(old.traction @ pose.turn.T, old.normal @ pose.turn.T, n))
        closing = -distance
        r_n = law.normal(self.k_n, closing, old.pressure)
        tau = law.tangential(self.k_t, n, step, before, step, r_n, closing, old.limit)
        traction = r_n[:, None] * n + tau
        found = {"normal": n, "closing": closing, "relative": pose.into(x) - self.x, "step": step}
        found |= {"before": before, "r_n": r_n, "tau": tau, "traction": traction}
        found |= {"framed": tau @ pose.turn, "inward": inward, "foot": pose.into(foot)}
        return found | {"turn": pose.turn}

    def seen_from(self, x: Array, pose: Pose) -> tuple[Array, Array]:
        """Distance of places from the obstacle, and its normal there."""
        distance, inward = self.shape(pose.into(x))
        return distance, inward @ pose.turn.T

    def at_rest(self) -> Pose:
        """See `reference.ContactModel`."""
        return self.pose(np.zeros(self.d), 0.0)

    def counted_from(self, found: dict[str, Array], old: Any, idle: Array) -> FiniteState:
        """See `reference.ContactModel`."""
        jump = np.where(idle[:, None], found["foot"], old.jump)
        return replace(old, jump=jump, normal=np.where(idle[:, None], found["inward"], old.normal))

    def augment(self, found: dict[str, Array], old: Any) -> FiniteState:
        """One round: the multipliers that the tractions found make."""
        pressure = self.project @ -found["r_n"] if self.law.has_normal else 0 * found["r_n"]
        traction = self.project @ found["framed"] if self.law.slips else old.traction
        return FiniteState(old.jump, traction, pressure, None, found["inward"])

    def next_state(self, found: dict[str, Array], old: Any) -> FiniteState:
        """History of the next increment; ``old`` with the multipliers it was found with."""
        if self.project is None:
            return FiniteState(found["foot"], found["framed"], None, None, found["inward"])
        foot = found["foot"]
        if self.law.slips:
            borne = self.law.stretch(self.k_t, found["normal"], found["before"] - found["tau"])
            foot = foot - borne @ found["turn"]
        return FiniteState(foot, old.traction.copy(), old.pressure, None, old.normal)


def _turned(vector: Array, before: Array, now: Array) -> Array:
    """Vectors turned with unit normals by the smallest rotation: two half turns."""

    def half_turn(v: Array, about: Array) -> Array:
        return 2 * np.sum(v * about, axis=1)[:, None] * about - v

    middle = before + now
    size = np.linalg.norm(middle, axis=1)[:, None]
    middle = np.where(size > 1e-6, middle / np.where(size > 1e-6, size, 1.0), now)
    return half_turn(half_turn(vector, before), middle)


# ---- the problem ---------------------------------------------------------------------------------


@dataclass(eq=False)
class FiniteLoad(reference.Load):
    """What drives an increment, the turn of the obstacles too.

    Attributes:
        angle: Radians.
        numbers: Of the scene: stage and load parameter.
    """

    angle: float = 0.0


@dataclass(eq=False)
class FiniteProblem(reference.Problem):
    """A body that may be nonlinear, and contacts on obstacles that move and turn.

    Attributes:
        bulk: Function of u: internal forces (N,), their derivative (N, N), and whether no cell is
            turned inside out.
        before: Load of the last solution.
        parts: Into how many an increment is cut, tried in turn.
    """

    bulk: Any = None
    before: Any = None
    parts: tuple[int, ...] = _PARTS

    def stiffness(self, u: Array) -> Array:
        """K at a displacement."""
        return self.bulk(u)[1]

    def shifts(self, load: Any, motion: Array) -> list[Any]:
        """Places of the obstacles."""
        moved = super().shifts(load, motion)
        return [c.pose(s, load.angle) for c, s in zip(self.contacts, moved, strict=True)]

    def residual(self, u: Array, load: Any, found: list[dict]) -> tuple[Array, Array]:
        """Internal forces - f - contact, and force on obstacles not balanced."""
        total = self.bulk(u)[0] - load.force - sum(self.contact_force(found))
        motion = [
            (self.contacts[c].weights @ found[c]["traction"])[i] - load.pushes[c][i]
            for c, i in self.motions()
        ]
        return total, np.array(motion)

    def solve(
        self, u: Array, motion: Array, load: Any, old: list[Any], *, rtol: float = 1e-12
    ) -> tuple[Array, Array, list[Any]]:
        """One increment, in parts; see `reference.Problem.solve`."""
        for parts in self.parts:
            with contextlib.suppress(Failed, np.linalg.LinAlgError):
                v, m = u, motion
                for share in np.arange(1, parts + 1) / parts:
                    v, m = self.increment_of(v, m, self._between(load, share), old, rtol)
                break
        else:
            v, m = self._stiffened(u, motion, load, old, rtol)
        for _ in range(_ROUNDS if any(c.project is not None for c in self.contacts) else 0):
            found = self.respond(v, m, load, old)
            new = [
                c.augment(f, o) if c.project is not None else o
                for c, f, o in zip(self.contacts, found, old, strict=True)
            ]
            pairs = [(a, b) for a, b in zip(new, old, strict=True) if a.pressure is not None]
            change = max(np.abs(a.pressure - b.pressure).max() for a, b in pairs)
            change = max(change, *(np.abs(a.traction - b.traction).max() for a, b in pairs))
            scale = max(np.abs(a.pressure).max() + np.abs(a.traction).max() for a, _ in pairs)
            old = new
            if change <= 1e-8 * scale + self.rounding():
                break
            v, m = self.increment_of(v, m, load, old, rtol)
        else:
            if any(c.project is not None for c in self.contacts):
                raise Failed("multipliers do not settle")
        self.before = load
        return v, m, old

    def _stiffened(
        self, u: Array, motion: Array, load: Any, old: list[Any], rtol: float
    ) -> tuple[Array, Array]:
        """With softer springs first."""
        whole = [(c.k_n, c.k_t) for c in self.contacts]
        try:
            for factor in _SOFTER:
                for contact, (k_n, k_t) in zip(self.contacts, whole, strict=True):
                    contact.k_n, contact.k_t = factor * k_n, factor * k_t
                u, motion = self.increment_of(u, motion, load, old, rtol)
        finally:
            for contact, (k_n, k_t) in zip(self.contacts, whole, strict=True):
                contact.k_n, contact.k_t = k_n, k_t
        return u, motion

    def _between(self, load: Any, share: float) -> Any:
        """Part of the way from the load before."""
        if share == 1.0:
            return load
        first = self.before

        def mean(name: str) -> Any:
            end = getattr(load, name)
            start = getattr(first, name) if first is not None else [0.0 * v for v in end]
            return [s + share * (e - s) for s, e in zip(start, end, strict=True)]

        angle = 0.0 if first is None else first.angle
        return replace(
            load,
            force=np.array(mean("force")),
            values=np.array(mean("values")),
            shifts=mean("shifts"),
            pushes=mean("pushes"),
            angle=angle + share * (load.angle - angle),
        )

    def increment_of(
        self, u: Array, motion: Array, load: Any, old: list[Any], rtol: float
    ) -> tuple[Array, Array]:
        """Newton's method with a line search."""
        free = self.motions()
        fixed = np.zeros(len(u), dtype=bool)
        fixed[load.fixed] = True
        kept = np.flatnonzero(~fixed)

        def evaluate(v: Array, m: Array) -> tuple[Array, float, Array, bool]:
            inside, stiff, whole = self.bulk(v)
            found = self.respond(v, m, load, old)
            forces = self.contact_force(found)
            total = inside - load.force - sum(forces)
            rest = [
                (self.contacts[c].weights @ found[c]["traction"])[i] - load.pushes[c][i]
                for c, i in free
            ]
            size = max(np.linalg.norm(f) for f in [*forces, load.force[kept], total[fixed]])
            size = max([size, *(abs(load.pushes[c][i]) for c, i in free)])
            floor = np.linalg.norm(np.abs(stiff) @ np.abs(v))
            for model in self.contacts:
                stiffest = model.weights * (model.k_n + model.k_t)
                floor += stiffest.sum() * np.abs(model.x + model.jump(v)).max()
            return np.concatenate([total[kept], rest]), size, floor, whole

        def tangent(v: Array, m: Array, *, closed: bool) -> Array:
            return self._tangent(v, m, load, old, kept, closed=closed)

        u, motion = u.copy(), motion.copy()
        u[load.fixed] = load.values
        rest, size, floor, whole = evaluate(u, motion)
        if not whole:
            raise Failed("cells are turned inside out")
        best, idle = (np.inf, u, motion, size, floor), 0
        for iteration in range(80):
            norm = float(np.linalg.norm(rest))
            idle = 0 if norm < 0.9 * best[0] else idle + 1
            if norm < best[0]:
                best = (norm, u.copy(), motion.copy(), size, floor)
            if norm <= rtol * size or norm <= 1e-15 * floor:
                break
            if idle > 4 and best[0] <= 1e-13 * floor:  # round-off, which falls no further
                break
            matrix = tangent(u, motion, closed=False)
            scale = np.sqrt(np.abs(np.diag(tangent(u, motion, closed=True))))
            system = matrix / scale[:, None] / scale
            held = bool(np.isfinite(system).all() and np.linalg.cond(system) < 1e12)
            if not held:
                system = tangent(u, motion, closed=True) / scale[:, None] / scale
            step = -np.linalg.solve(system, rest / scale) / scale
            first = np.linalg.norm(rest / scale)
            share, low, high, chosen = 1.0, 0.0, np.inf, None
            for _ in range(40 if not held else 12):
                v, m = u.copy(), motion.copy()
                v[kept] += share * step[: len(kept)]
                m += share * step[len(kept) :]
                now = evaluate(v, m)
                valid = now[3] and np.isfinite(now[0]).all()
                if valid:
                    chosen = (v, m, now)
                if not held:
                    # Nothing holds the body: on until something does, by the force along the way.
                    along, slope = now[0] @ step, rest @ step
                    if valid and abs(along) <= 0.3 * abs(slope):
                        break
                    low, high = (share, high) if valid and along < 0 else (low, share)
                    share = 2 * share if high == np.inf else 0.5 * (low + high)
                    continue
                # Out of a cycle, now and then.
                free_pass = iteration % 9 == 8 and share < 0.5
                if valid and (
                    free_pass or np.linalg.norm(now[0] / scale) < (1 - 0.1 * share) * first
                ):
                    break
                share *= 0.5
            if chosen is None:
                break
            u, motion, (rest, size, floor, _) = chosen
        norm, u, motion, size, floor = best
        if norm > 1e3 * rtol * size and norm > 1e-13 * floor:
            raise Failed(f"residual {norm / max(size, 1e-300):.1e} of the forces")
        return u, motion

    def _tangent(
        self, v: Array, m: Array, load: Any, old: list[Any], kept: Array, *, closed: bool
    ) -> Array:
        """Derivative of what is free; ``closed``: as if springs held all points every way."""
        d, free = self.body.d, self.motions()
        reach = _DIFFERENCE * np.ptp(self.body.places, axis=0).max()
        matrix = np.zeros((len(kept) + len(free),) * 2)
        matrix[: len(kept), : len(kept)] = self.bulk(v)[1][np.ix_(kept, kept)]
        shifts = self.shifts(load, m)
        for c, model in enumerate(self.contacts):
            left = np.zeros((model.x.size, len(matrix)))
            left[:, : len(kept)] = np.kron(model.interpolation, np.eye(d))[:, kept]
            for k, (o, i) in enumerate(free):
                if o == c:
                    left[i::d, len(kept) + k] = -1.0
            jump = model.jump(v)
            blocks = np.zeros((len(jump), d, d))
            if closed:
                blocks[:] = -np.eye(d) * np.maximum(model.k_n, model.k_t)[:, None, None]
            else:
                for i in range(d):
                    way = reach * np.eye(d)[i]
                    ends = [
                        model.respond(jump + s * way, shifts[c], old[c])["traction"]
                        for s in (1, -1)
                    ]
                    blocks[:, :, i] = (ends[0] - ends[1]) / (2 * reach)
            blocks *= model.weights[:, None, None]
            felt = np.einsum("qij,qjn->qin", blocks, left.reshape(len(jump), d, -1))
            matrix -= left.T @ felt.reshape(left.shape)
            for k, (o, i) in enumerate(free):  # the history moves along with the obstacle
                if o == c and not closed:
                    ends = []
                    for s in (1, -1):
                        moved = replace(shifts[c], shift=shifts[c].shift + s * reach * np.eye(d)[i])
                        there = model.respond(jump, moved, old[c])["traction"]
                        ends.append((model.weights[:, None] * there).ravel())
                    by = (ends[0] - ends[1]) / (2 * reach)
                    matrix[:, len(kept) + k] = -left.T @ by
        return matrix


def rubber(u: Any, v: Any, E: Any, nu: Any) -> Any:
    """Virtual work of neo-Hookean rubber by its first Piola-Kirchhoff stress (UFL)."""
    d = len(u)
    F = ufl.Identity(d) + ufl.grad(u)
    J, away = ufl.det(F), ufl.inv(F).T
    shear, lame = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    return ufl.inner(shear * (F - away) + lame / 2 * (J**2 - 1) * away, ufl.grad(v))


def model(
    scene: dict[str, Any],
) -> tuple[FiniteProblem, Any, Callable[[int, float], FiniteLoad]]:
    """The second problem, and its loads by stage and load parameter. On one rank."""
    made = finite_scenes.FiniteMade(scene, MPI.COMM_SELF, bulk=rubber)
    body, surface = fuzz_models.body_of(made)
    contacts = []
    for i, contact in enumerate(scene["contacts"]):
        made_contact, _ = fuzz_models.contact_of(made, contact, surface(11 + i), FiniteContact)
        made_contact.shape = shape_of(scene, contact)
        made_contact.near = made_contact.seen_from
        turn = made.turn(contact)
        if turn is not None:
            made_contact.turns = True
            made_contact.about, made_contact.axis = (
                np.array(turn[0], dtype=float),
                None if turn[1] is None else np.array(turn[1], dtype=float),
            )
        contacts.append(made_contact)
    return FiniteProblem(body, contacts, bulk=bulk_of(made, body)), made, loads_of(made)


def bulk_of(made: Any, body: Body) -> Callable[[Array], tuple[Array, Array, bool]]:
    """Of u: internal forces, their derivative, and whether no cell is turned inside out."""
    d, V = made.d, made.V
    nonlinear = made.scene["bulk"] == "rubber"
    outside = made.outside()
    tangent = ufl.derivative(made.F, made.u, ufl.TrialFunction(V))
    inner, outer = fem.form(made.F), fem.form(tangent)
    volume = ufl.det(ufl.Identity(d) + ufl.grad(made.u))
    dx = ufl.Measure("dx", made.mesh, metadata={"quadrature_degree": finite_scenes.DEGREE + 2})
    inverted = fem.form(ufl.conditional(ufl.gt(volume, 0.0), 0.0, 1.0) * dx)
    memory: dict[bytes, Any] = {}

    def bulk(u: Array) -> tuple[Array, Array, bool]:
        if not nonlinear:
            return body.stiffness @ u, body.stiffness, True
        key = u.tobytes()
        if key not in memory:
            # F less the loads: their part of it is assembled with them at u = 0.
            made.u.x.array[:] = u
            force = fem.assemble_vector(inner).array + fem.assemble_vector(outside).array
            stiff = fem.assemble_matrix(outer).to_scipy().toarray()
            memory.clear()
            memory[key] = force.copy(), stiff, fem.assemble_scalar(inverted) == 0.0
        return memory[key]

    return bulk


def loads_of(made: Any) -> Callable[[int, float], FiniteLoad]:
    """What drives the bodies, by stage and load parameter."""
    d, V, scene = made.d, made.V, made.scene
    outside = made.outside()

    def load(stage: int, t: float) -> FiniteLoad:
        made.apply(stage, t)
        values = np.zeros(V.dofmap.index_map.size_local * d)
        for bc in made.bcs:
            bc.set(values)
        dofs = np.unique(np.concatenate([bc.dof_indices()[0] for bc in made.bcs]))
        shifts, pushes = [], []
        for contact in scene["contacts"]:
            moving, free = contact["obstacle"].get("moving"), contact["obstacle"].get("free", ())
            shift, push = np.zeros(d), np.zeros(d)
            if moving == "displacement":
                shift = made.shift.value.copy()
            elif moving == "carried":
                shift = made.carried.value.copy()
            elif moving == "force":
                for i in range(d):
                    push[i] = float(made.push[i].value) if i in free else 0.0
                    shift[i] = 0.0 if i in free else float(made.pull[i].value)
            shifts.append(shift)
            pushes.append(push)
        force = fem.assemble_vector(outside).array.copy()
        angle = float(made.angle.value)
        return FiniteLoad(force, dofs, values[dofs], shifts, pushes, angle)

    return load


# ---- the judge -----------------------------------------------------------------------------------


class FiniteJudge(fuzz_judge.Judge):
    """Takes the package's increments one by one; see `fuzz_judge.Judge`.

    Energies are not made anew. With friction, rubber or curved obstacles an increment may have
    several solutions: one that differs from that found apart is "another".
    """

    @staticmethod
    def _model(scene: dict[str, Any]) -> Any:
        return model(scene)

    def take(self, record: dict[str, Any]) -> None:
        """Judge one committed increment."""
        load = self._load(record["stage"], record["load"])
        super().take(record)
        self.problem.before = self._apart.before = load
        whole = self.problem.bulk(self._u)[2]
        name = f"stage {record['stage']} at {record['load']:.4g}"
        self._check(name, "inside out", 0.0 if whole else 2.0, 1.0)

    def _with_multipliers(self, contact: Any, old: Any, record: dict[str, Any]) -> Any:
        if contact.project is None:
            return old
        row = self._rows(contact, record)
        traction, normal = old.traction, old.normal
        if contact.law.slips:
            traction, normal = record["lambda_t"][row], record["lambda_at"][row]
        return FiniteState(old.jump, traction, record["lambda_n"][row], None, normal)

    def _bulges(self, given: dict[str, Any]) -> float:
        """A round obstacle rises into a facet by L² / 8 R."""
        bulges = super()._bulges(given)
        if given["obstacle"]["kind"] in ("body", "rod"):
            return bulges
        body = self.scene["bodies"][given["body"]]
        radius = finite_scenes.place_of(self.scene, given).get("radius", np.inf)
        length = max(s / n for s, n in zip(body["size"][:-1], body["n"][:-1], strict=True))
        length *= self.scene["units"][0]
        return float(bulges + length**2 / (8 * radius))

    def _check_kinematics(self, *_: Any) -> None:
        """Nothing is taken for small."""

    def _check_energy(self, name: str, record: Any, *_: Any) -> None:
        """Friction takes energy, by the means of tractions at both ends (as the verdict has it)."""

    def _unique(self) -> bool:
        plain = all(c.law.unique and not c.free for c in self.problem.contacts)
        flat = all(c["obstacle"]["kind"] == "halfspace" for c in self.scene["contacts"])
        return plain and flat and self.scene["bulk"] == "linear" and not self._slips()

    def _slips(self) -> bool:
        return any(c.law.slips for c in self.problem.contacts)
