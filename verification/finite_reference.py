"""The independent solver with finite kinematics on rigid obstacles, and its comparison.

Distances and normals, moving and rotating frames, slip, rotation of the committed traction and the
stress of rubber are closed formulas at points, in NumPy; the return map is that of
`reference_laws`. Only the scene and DOLFINx's assembly of the bulk are shared with the package.
Tractions are differentiated by finite differences. Newton's method with a line search solves an
increment in several parts, with the history at the start of the increment.
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

from verification import finite_scenes, fuzz_comparison, fuzz_reference
from verification import reference_solver as reference
from verification.reference_geometry import Body
from verification.reference_solver import NotSolved

__all__ = [
    "FiniteComparison",
    "FiniteContact",
    "FiniteProblem",
    "make_bulk",
    "make_loads",
    "make_problem",
    "make_shape",
    "rubber_work",
]

Array = np.ndarray
# Signed distance, (n,), and minus its gradient, (n, d), at points (n, d).
GapFunction = Callable[[Array], tuple[Array, Array]]

# Step of finite differences relative to the size of the mesh, below the elastic penetration.
_DIFFERENCE = 1e-8
# Numbers of parts into which an increment is divided, in the order of attempts; factors of the
# contact stiffness in its continuation; and largest number of augmentations.
_SUBDIVISIONS = (4, 32)
_STIFFNESS_FACTORS = 10.0 ** np.arange(-5, 0.1, 0.5)
_MAX_AUGMENTATIONS = 400


# ---- shapes --------------------------------------------------------------------------------------


def make_shape(scene: dict[str, Any], contact: dict[str, Any]) -> GapFunction:
    """Return the gap function of an obstacle, by formulas or by search over all of its data."""
    given, where = contact["obstacle"], finite_scenes.initial_geometry(scene, contact)
    kind, d = given["kind"], len(scene["bodies"][0]["size"])
    if contact["side"] == "right" or kind == "halfspace":
        normal = where["normal"]
        return lambda x: ((x - where["point"]) @ normal, np.tile(-normal, (len(x), 1)))
    if kind.startswith(("ball", "cylinder")):
        projector = np.eye(d)
        if kind.startswith("cylinder") and d == 3:
            axis = np.array(given.get("axis", (0.0, 1.0, 0.0)))
            projector -= np.outer(axis, axis) / (axis @ axis)
        sign = -1.0 if kind.endswith("inside") else 1.0
        return lambda x: _radial_gap((x - where["center"]) @ projector, where["radius"], sign)
    if kind in ("capsule", "rod"):
        return lambda x: fuzz_reference.capsule_gap_at(x, where)
    if kind == "torus":
        centre = where["center"] - where["ring"] * np.eye(3)[0]

        def torus(x: Array) -> tuple[Array, Array]:
            arm = (x - centre) * [1.0, 1.0, 0.0]
            ring = where["ring"] * arm / np.linalg.norm(arm, axis=1)[:, None]
            return _radial_gap(x - centre - ring, where["radius"], 1.0)

        return torus
    if kind in ("facets", "box"):
        points, numbers = finite_scenes.obstacle_points(scene, contact)
        return _polyhedron_gap(points[numbers])
    points, _ = finite_scenes.obstacle_points(scene, contact)
    if kind == "turned profile":  # closed by its mirror image
        flat = (points - where["center"])[:, [0, 2]]
        loop = _spline_gap(np.concatenate([flat, flat[-2:0:-1] * [-1.0, 1.0]]))

        def revolved(x: Array) -> tuple[Array, Array]:
            arm = x - where["center"]
            out = np.hypot(arm[:, 0], arm[:, 1])
            distance, normal = loop(np.column_stack([out, arm[:, 2]]))
            direction = arm[:, :2] / out[:, None]
            return distance, np.column_stack([normal[:, :1] * direction, normal[:, 1]])

        return revolved
    loop = _spline_gap(points[:, [0, -1]])
    if d == 2:
        return loop

    def extruded(x: Array) -> tuple[Array, Array]:
        distance, normal = loop(x[:, [0, 2]])
        return distance, np.column_stack([normal[:, 0], np.zeros(len(x)), normal[:, 1]])

    return extruded


def _radial_gap(arm: Array, radius: float, sign: float) -> tuple[Array, Array]:
    far = np.sqrt(np.sum(arm * arm, axis=1))
    return sign * (far - radius), -sign * arm / far[:, None]


def _spline_gap(points: Array) -> GapFunction:
    """Return the gap function of a closed anticlockwise cubic spline, parametrised by chords."""
    stick = np.vstack([points, points[:1]])
    knots = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(stick, axis=0), axis=1)))
    spline = scipy.interpolate.CubicSpline(knots, stick, bc_type="periodic")
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


def _polyhedron_gap(corners: Array) -> GapFunction:
    """Return the gap function of a convex polyhedron with outward facets, (m, d, d)."""
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
        # Outside, the closest facet, edge or corner is used.
        closest = x[:, None] - height[:, :, None] * out
        below = np.ones(height.shape, dtype=bool)
        arms = []
        for i in range(d if d == 3 else 1):
            a, b = corners[:, i], corners[:, (i + 1) % d]
            direction = b - a
            if d == 3:
                side = np.cross(direction[None], closest - a)
                below &= np.sum(side * out, axis=2) >= 0
            fraction = np.sum((x[:, None] - a) * direction, axis=2) / np.sum(
                direction * direction, axis=1
            )
            if d == 2:
                below &= (fraction >= 0) & (fraction <= 1)
            near = a + np.clip(fraction, 0, 1)[:, :, None] * direction
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
    """Position of an obstacle: x = R (z - c) + c + shift."""

    rotation: Array
    rotation_centre: Array
    shift: Array

    def to_obstacle_frame(self, x: Array) -> Array:
        """Return points in the frame of the obstacle."""
        return (x - self.rotation_centre - self.shift) @ self.rotation + self.rotation_centre

    def to_space(self, z: Array) -> Array:
        """Return points in space."""
        return (z - self.rotation_centre) @ self.rotation.T + self.rotation_centre + self.shift


@dataclass(eq=False)
class FiniteState(reference.State):
    """Committed state in the frame of the obstacle.

    Attributes:
        jump: Closest-point projection that is the slip reference, (n, d) (length).
        traction: τ, or with multipliers λ_t.
        normal: Normal at the projection.
    """

    normal: Array | None = None


@dataclass(eq=False)
class FiniteContact(reference.ContactModel):
    """A contact with a rigid obstacle at the deformed positions.

    Attributes:
        shape: Gap function of the obstacle in its first position.
        rotation_centre: A point on the axis of rotation.
        axis: Direction of the axis in 3D; None in the plane.
        rotates: Whether the obstacle rotates.
    """

    shape: Any = None
    rotation_centre: Any = None
    axis: Any = None
    rotates: bool = False

    def pose(self, shift: Array, angle: float) -> Pose:
        """Return the position of the obstacle."""
        if not self.rotates:
            return Pose(np.eye(self.d), np.zeros(self.d), shift)
        if self.d == 2:
            rotation = scipy.spatial.transform.Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
            return Pose(rotation[:2, :2], self.rotation_centre, shift)
        along = angle * self.axis / np.linalg.norm(self.axis)
        rotation = scipy.spatial.transform.Rotation.from_rotvec(along).as_matrix()
        return Pose(rotation, self.rotation_centre, shift)

    def centreline_at(self, shift: Any) -> Array:
        """Return the centreline of a rod."""
        return shift.to_space(self.centreline)

    def initial_state(self) -> FiniteState:
        """Return the state without traction, on the obstacle in its first position."""
        distance, normal = self.shape(self.x)
        zero = np.zeros_like(self.x)
        pressure = None if self.projection is None else np.zeros(len(zero))
        return FiniteState(self.x + distance[:, None] * normal, zero, pressure, None, normal)

    def evaluate(self, jump: Array, shift: Any, old: Any) -> dict[str, Array]:
        """Return tractions and local kinematics; ``shift`` is a `Pose`."""
        pose, law = shift, self.law
        x = self.x + jump
        distance, local_normal = self.shape(pose.to_obstacle_frame(x))
        n = local_normal @ pose.rotation.T
        closest = x + distance[:, None] * n

        def across(vector: Array) -> Array:
            return vector - np.sum(vector * n, axis=1)[:, None] * n

        step = across(closest - pose.to_space(old.jump))
        before = across(
            _rotate_with_normal(old.traction @ pose.rotation.T, old.normal @ pose.rotation.T, n)
        )
        overclosure = -distance
        r_n = law.normal_traction(self.k_n, overclosure, old.pressure)
        tau = law.tangential_traction(self.k_t, n, step, before, step, r_n, overclosure, old.bound)
        traction = r_n[:, None] * n + tau
        found = {"normal": n, "overclosure": overclosure, "slip": step}
        found |= {"tau_old": before, "r_n": r_n, "tau": tau, "traction": traction}
        found |= {
            "relative": pose.to_obstacle_frame(x) - self.x,
            "projection": pose.to_obstacle_frame(closest),
        }
        found |= {"tau_local": tau @ pose.rotation, "n_local": local_normal}
        return found | {"rotation": pose.rotation}

    def gap_at(self, x: Array, pose: Pose) -> tuple[Array, Array]:
        """Return gap and normal at points in space."""
        distance, local_normal = self.shape(pose.to_obstacle_frame(x))
        return distance, local_normal @ pose.rotation.T

    def initial_position(self) -> Pose:
        """Return the first position of the obstacle."""
        return self.pose(np.zeros(self.d), 0.0)

    def reset_slip(self, found: dict[str, Array], old: Any, unloaded: Array) -> FiniteState:
        """Move the slip reference of unloaded points to an evaluated state."""
        jump = np.where(unloaded[:, None], found["projection"], old.jump)
        return replace(
            old, jump=jump, normal=np.where(unloaded[:, None], found["n_local"], old.normal)
        )

    def augment(self, found: dict[str, Array], old: Any) -> FiniteState:
        """Return the state after one augmentation."""
        pressure = self.projection @ -found["r_n"] if self.law.has_normal else 0 * found["r_n"]
        traction = self.projection @ found["tau_local"] if self.law.has_friction else old.traction
        return FiniteState(old.jump, traction, pressure, None, found["n_local"])

    def next_state(self, found: dict[str, Array], old: Any) -> FiniteState:
        """Return the state to commit; ``old`` has the multipliers of the solution."""
        if self.projection is None:
            return FiniteState(
                found["projection"], found["tau_local"], None, None, found["n_local"]
            )
        reference_point = found["projection"]
        if self.law.has_friction:
            change = found["tau_old"] - found["tau"]
            slip = self.law.elastic_slip(self.k_t, found["normal"], change)
            reference_point = reference_point - slip @ found["rotation"]
        return FiniteState(reference_point, old.traction.copy(), old.pressure, None, old.normal)


def _rotate_with_normal(vector: Array, before: Array, now: Array) -> Array:
    """Rotate vectors by the smallest rotation from one normal to the other, by two half turns."""

    def half_turn(v: Array, about: Array) -> Array:
        return 2 * np.sum(v * about, axis=1)[:, None] * about - v

    middle = before + now
    size = np.linalg.norm(middle, axis=1)[:, None]
    middle = np.where(size > 1e-6, middle / np.where(size > 1e-6, size, 1.0), now)
    return half_turn(half_turn(vector, before), middle)


# ---- the problem ---------------------------------------------------------------------------------


@dataclass(eq=False)
class FiniteLoad(reference.Load):
    """Load at the end of an increment, with the angle of the obstacle (radians)."""

    angle: float = 0.0


@dataclass(eq=False)
class FiniteProblem(reference.Problem):
    """A linear or nonlinear bulk with contacts on moving and rotating obstacles.

    Attributes:
        bulk: Function of u: internal forces (N,), tangent (N, N), and whether no cell is inverted.
        before: Load of the last solution.
        subdivisions: Numbers of parts of an increment, in the order of attempts.
    """

    bulk: Any = None
    before: Any = None
    subdivisions: tuple[int, ...] = _SUBDIVISIONS

    def stiffness(self, u: Array) -> Array:
        """Return the tangent stiffness of the bulk."""
        return self.bulk(u)[1]

    def shifts(self, load: Any, motion: Array) -> list[Any]:
        """Return the positions of the obstacles."""
        moved = super().shifts(load, motion)
        return [c.pose(s, load.angle) for c, s in zip(self.contacts, moved, strict=True)]

    def residual(self, u: Array, load: Any, found: list[dict]) -> tuple[Array, Array]:
        """Return the residual of all dofs, and that of the free obstacle motions."""
        total = self.bulk(u)[0] - load.force - sum(self.contact_force(found))
        motion = [
            (self.contacts[c].weights @ found[c]["traction"])[i] - load.obstacle_forces[c][i]
            for c, i in self.free_motions()
        ]
        return total, np.array(motion)

    def solve(
        self, u: Array, motion: Array, load: Any, old: list[Any], *, rtol: float = 1e-12
    ) -> tuple[Array, Array, list[Any]]:
        """Solve one increment in parts, with the arguments of `reference.Problem.solve`."""
        for n_parts in self.subdivisions:
            with contextlib.suppress(NotSolved, np.linalg.LinAlgError):
                v, m = u, motion
                for fraction in np.arange(1, n_parts + 1) / n_parts:
                    v, m = self.equilibrate(v, m, self._interpolate_load(load, fraction), old, rtol)
                break
        else:
            v, m = self._solve_with_softer_springs(u, motion, load, old, rtol)
        for _ in range(
            _MAX_AUGMENTATIONS if any(c.projection is not None for c in self.contacts) else 0
        ):
            found = self.evaluate(v, m, load, old)
            new = [
                c.augment(f, o) if c.projection is not None else o
                for c, f, o in zip(self.contacts, found, old, strict=True)
            ]
            pairs = [(a, b) for a, b in zip(new, old, strict=True) if a.pressure is not None]
            change = max(np.abs(a.pressure - b.pressure).max() for a, b in pairs)
            change = max(change, *(np.abs(a.traction - b.traction).max() for a, b in pairs))
            scale = max(np.abs(a.pressure).max() + np.abs(a.traction).max() for a, _ in pairs)
            old = new
            if change <= 1e-8 * scale + self.traction_roundoff():
                break
            v, m = self.equilibrate(v, m, load, old, rtol)
        else:
            if any(c.projection is not None for c in self.contacts):
                raise NotSolved("multipliers do not converge")
        self.before = load
        return v, m, old

    def _solve_with_softer_springs(
        self, u: Array, motion: Array, load: Any, old: list[Any], rtol: float
    ) -> tuple[Array, Array]:
        """Solve by continuation in the contact stiffness."""
        whole = [(c.k_n, c.k_t) for c in self.contacts]
        try:
            for factor in _STIFFNESS_FACTORS:
                for contact, (k_n, k_t) in zip(self.contacts, whole, strict=True):
                    contact.k_n, contact.k_t = factor * k_n, factor * k_t
                u, motion = self.equilibrate(u, motion, load, old, rtol)
        finally:
            for contact, (k_n, k_t) in zip(self.contacts, whole, strict=True):
                contact.k_n, contact.k_t = k_n, k_t
        return u, motion

    def _interpolate_load(self, load: Any, fraction: float) -> Any:
        """Return the load at a ``fraction`` of the increment, by linear interpolation."""
        if fraction == 1.0:
            return load
        first = self.before

        def mean(name: str) -> Any:
            end = getattr(load, name)
            start = getattr(first, name) if first is not None else [0.0 * v for v in end]
            return [s + fraction * (e - s) for s, e in zip(start, end, strict=True)]

        angle = 0.0 if first is None else first.angle
        return replace(
            load,
            force=np.array(mean("force")),
            values=np.array(mean("values")),
            shifts=mean("shifts"),
            obstacle_forces=mean("obstacle_forces"),
            angle=angle + fraction * (load.angle - angle),
        )

    def equilibrate(
        self, u: Array, motion: Array, load: Any, old: list[Any], rtol: float
    ) -> tuple[Array, Array]:
        """Solve by Newton's method with a line search."""
        free = self.free_motions()
        fixed = np.zeros(len(u), dtype=bool)
        fixed[load.fixed] = True
        free_dofs = np.flatnonzero(~fixed)

        def evaluate(v: Array, m: Array) -> tuple[Array, float, Array, bool]:
            inside, stiff, whole = self.bulk(v)
            found = self.evaluate(v, m, load, old)
            forces = self.contact_force(found)
            total = inside - load.force - sum(forces)
            residual = [
                (self.contacts[c].weights @ found[c]["traction"])[i] - load.obstacle_forces[c][i]
                for c, i in free
            ]
            size = max(np.linalg.norm(f) for f in [*forces, load.force[free_dofs], total[fixed]])
            size = max([size, *(abs(load.obstacle_forces[c][i]) for c, i in free)])
            roundoff = np.linalg.norm(np.abs(stiff) @ np.abs(v))
            for model in self.contacts:
                stiffest = model.weights * (model.k_n + model.k_t)
                roundoff += stiffest.sum() * np.abs(model.x + model.jump(v)).max()
            return np.concatenate([total[free_dofs], residual]), size, roundoff, whole

        def tangent(v: Array, m: Array, *, stick: bool) -> Array:
            return self._tangent(v, m, load, old, free_dofs, stick=stick)

        u, motion = u.copy(), motion.copy()
        u[load.fixed] = load.values
        residual, size, roundoff, whole = evaluate(u, motion)
        if not whole:
            raise NotSolved("cells are inverted")
        best, idle = (np.inf, u, motion, size, roundoff), 0
        for iteration in range(80):
            norm = float(np.linalg.norm(residual))
            idle = 0 if norm < 0.9 * best[0] else idle + 1
            if norm < best[0]:
                best = (norm, u.copy(), motion.copy(), size, roundoff)
            if norm <= rtol * size or norm <= 1e-15 * roundoff:
                break
            if idle > 4 and best[0] <= 1e-13 * roundoff:  # only round-off remains
                break
            matrix = tangent(u, motion, stick=False)
            scale = np.sqrt(np.abs(np.diag(tangent(u, motion, stick=True))))
            system = matrix / scale[:, None] / scale
            is_constrained = bool(np.isfinite(system).all() and np.linalg.cond(system) < 1e12)
            if not is_constrained:
                system = tangent(u, motion, stick=True) / scale[:, None] / scale
            step = -np.linalg.solve(system, residual / scale) / scale
            first = np.linalg.norm(residual / scale)
            step_length, low, high, chosen = 1.0, 0.0, np.inf, None
            for _ in range(40 if not is_constrained else 12):
                v, m = u.copy(), motion.copy()
                v[free_dofs] += step_length * step[: len(free_dofs)]
                m += step_length * step[len(free_dofs) :]
                now = evaluate(v, m)
                valid = now[3] and np.isfinite(now[0]).all()
                if valid:
                    chosen = (v, m, now)
                if not is_constrained:
                    # The body is unconstrained: find a zero of the force along the step.
                    along, slope = now[0] @ step, residual @ step
                    if valid and abs(along) <= 0.3 * abs(slope):
                        break
                    low, high = (step_length, high) if valid and along < 0 else (low, step_length)
                    step_length = 2 * step_length if high == np.inf else 0.5 * (low + high)
                    continue
                # Every ninth iteration accepts a larger residual, to leave a cycle.
                free_pass = iteration % 9 == 8 and step_length < 0.5
                if valid and (
                    free_pass or np.linalg.norm(now[0] / scale) < (1 - 0.1 * step_length) * first
                ):
                    break
                step_length *= 0.5
            if chosen is None:
                break
            u, motion, (residual, size, roundoff, _) = chosen
        norm, u, motion, size, roundoff = best
        if norm > 1e3 * rtol * size and norm > 1e-13 * roundoff:
            raise NotSolved(f"residual {norm / max(size, 1e-300):.1e} of the forces")
        return u, motion

    def _tangent(
        self, v: Array, m: Array, load: Any, old: list[Any], free_dofs: Array, *, stick: bool
    ) -> Array:
        """Return the tangent of the free unknowns, with all points sticking if ``stick``."""
        d, free = self.body.d, self.free_motions()
        reach = _DIFFERENCE * np.ptp(self.body.nodes_x, axis=0).max()
        matrix = np.zeros((len(free_dofs) + len(free),) * 2)
        matrix[: len(free_dofs), : len(free_dofs)] = self.bulk(v)[1][np.ix_(free_dofs, free_dofs)]
        shifts = self.shifts(load, m)
        for c, model in enumerate(self.contacts):
            left = np.zeros((model.x.size, len(matrix)))
            left[:, : len(free_dofs)] = np.kron(model.interpolation, np.eye(d))[:, free_dofs]
            for k, (o, i) in enumerate(free):
                if o == c:
                    left[i::d, len(free_dofs) + k] = -1.0
            jump = model.jump(v)
            blocks = np.zeros((len(jump), d, d))
            if stick:
                blocks[:] = -np.eye(d) * np.maximum(model.k_n, model.k_t)[:, None, None]
            else:
                for i in range(d):
                    direction = reach * np.eye(d)[i]
                    ends = [
                        model.evaluate(jump + s * direction, shifts[c], old[c])["traction"]
                        for s in (1, -1)
                    ]
                    blocks[:, :, i] = (ends[0] - ends[1]) / (2 * reach)
            blocks *= model.weights[:, None, None]
            coupled = np.einsum("qij,qjn->qin", blocks, left.reshape(len(jump), d, -1))
            matrix -= left.T @ coupled.reshape(left.shape)
            for k, (o, i) in enumerate(free):  # the slip reference moves with the obstacle
                if o == c and not stick:
                    ends = []
                    for s in (1, -1):
                        moved = replace(shifts[c], shift=shifts[c].shift + s * reach * np.eye(d)[i])
                        traction = model.evaluate(jump, moved, old[c])["traction"]
                        ends.append((model.weights[:, None] * traction).ravel())
                    by = (ends[0] - ends[1]) / (2 * reach)
                    matrix[:, len(free_dofs) + k] = -left.T @ by
        return matrix


def rubber_work(u: Any, v: Any, E: Any, nu: Any) -> Any:
    """Return the virtual work of neo-Hookean rubber by its first Piola–Kirchhoff stress (UFL)."""
    d = len(u)
    F = ufl.Identity(d) + ufl.grad(u)
    J, away = ufl.det(F), ufl.inv(F).T
    shear, lame = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    return ufl.inner(shear * (F - away) + lame / 2 * (J**2 - 1) * away, ufl.grad(v))


def make_problem(
    scene: dict[str, Any],
) -> tuple[FiniteProblem, Any, Callable[[int, float], FiniteLoad]]:
    """Return the independent problem, the setup, and the load function, on one rank."""
    setup = finite_scenes.FiniteSetup(scene, MPI.COMM_SELF, bulk=rubber_work)
    body, surface = fuzz_reference.make_body(setup)
    contacts = []
    for i, contact in enumerate(scene["contacts"]):
        contact_model, _ = fuzz_reference.make_contact(
            setup, contact, surface(11 + i), FiniteContact
        )
        contact_model.shape = make_shape(scene, contact)
        contact_model.deformed_gap = contact_model.gap_at
        axis = setup.rotation_axis(contact)
        if axis is not None:
            contact_model.rotates = True
            contact_model.rotation_centre, contact_model.axis = (
                np.array(axis[0], dtype=float),
                None if axis[1] is None else np.array(axis[1], dtype=float),
            )
        contacts.append(contact_model)
    return FiniteProblem(body, contacts, bulk=make_bulk(setup, body)), setup, make_loads(setup)


def make_bulk(setup: Any, body: Body) -> Callable[[Array], tuple[Array, Array, bool]]:
    """Return a function of u: internal forces, tangent, and whether no cell is inverted."""
    d, V = setup.d, setup.V
    nonlinear = setup.scene["bulk"] == "rubber"
    outside = setup.external_force()
    tangent = ufl.derivative(setup.F, setup.u, ufl.TrialFunction(V))
    inner, outer = fem.form(setup.F), fem.form(tangent)
    volume = ufl.det(ufl.Identity(d) + ufl.grad(setup.u))
    dx = ufl.Measure("dx", setup.mesh, metadata={"quadrature_degree": finite_scenes.DEGREE + 2})
    inverted = fem.form(ufl.conditional(ufl.gt(volume, 0.0), 0.0, 1.0) * dx)
    memory: dict[bytes, Any] = {}

    def bulk(u: Array) -> tuple[Array, Array, bool]:
        if not nonlinear:
            return body.stiffness @ u, body.stiffness, True
        key = u.tobytes()
        if key not in memory:
            # F contains the loads, which are removed from the internal forces.
            setup.u.x.array[:] = u
            force = fem.assemble_vector(inner).array + fem.assemble_vector(outside).array
            stiff = fem.assemble_matrix(outer).to_scipy().toarray()
            memory.clear()
            memory[key] = force.copy(), stiff, fem.assemble_scalar(inverted) == 0.0
        return memory[key]

    return bulk


def make_loads(setup: Any) -> Callable[[int, float], FiniteLoad]:
    """Return the load as a function of stage and load parameter."""
    d, V = setup.d, setup.V
    outside = setup.external_force()

    def load(stage: int, t: float) -> FiniteLoad:
        setup.apply(stage, t)
        values = np.zeros(V.dofmap.index_map.size_local * d)
        for bc in setup.bcs:
            bc.set(values)
        dofs = np.unique(np.concatenate([bc.dof_indices()[0] for bc in setup.bcs]))
        shifts, obstacle_forces = setup.obstacle_loads()
        force = fem.assemble_vector(outside).array.copy()
        angle = float(setup.angle.value)
        return FiniteLoad(force, dofs, values[dofs], shifts, obstacle_forces, angle)

    return load


# ---- comparison ----------------------------------------------------------------------------------


class FiniteComparison(fuzz_comparison.Comparison):
    """Compares increments of the package with the independent solver, with finite kinematics.

    Energies are not compared. With friction, rubber or curved obstacles an increment may have
    several solutions: a difference from the independent history is then "another", not "wrong".
    """

    @staticmethod
    def _make_problem(scene: dict[str, Any]) -> Any:
        return make_problem(scene)

    def check_increment(self, record: dict[str, Any]) -> None:
        """Compare one committed increment."""
        load = self._load(record["stage"], record["load"])
        super().check_increment(record)
        self.problem.before = self._other.before = load
        whole = self.problem.bulk(self._u)[2]
        name = f"stage {record['stage']} at {record['load']:.4g}"
        self._check(name, "inverted cells", 0.0 if whole else 2.0, 1.0)

    def _with_multipliers(self, contact: Any, old: Any, record: dict[str, Any]) -> Any:
        if contact.projection is None:
            return old
        row = self._rows_of(contact, record)
        traction, normal = old.traction, old.normal
        if contact.law.has_friction:
            traction, normal = record["lambda_t"][row], record["lambda_at"][row]
        return FiniteState(old.jump, traction, record["lambda_n"][row], None, normal)

    def _flatness(self, given: dict[str, Any]) -> float:
        """Return the deviation from planes; that of a round obstacle is L²/(8 R) within a facet."""
        bulges = super()._flatness(given)
        if given["obstacle"]["kind"] in ("body", "rod"):
            return bulges
        body = self.scene["bodies"][given["body"]]
        radius = finite_scenes.initial_geometry(self.scene, given).get("radius", np.inf)
        length = max(s / n for s, n in zip(body["size"][:-1], body["n"][:-1], strict=True))
        length *= self.scene["units"][0]
        return float(bulges + length**2 / (8 * radius))

    def _check_kinematics(self, *_: Any) -> None:
        """Check nothing: displacements are not assumed small."""

    def _check_energy(self, name: str, record: Any, *_: Any) -> None:
        """Check nothing: energies are not compared."""

    def _is_unique(self) -> bool:
        plain = all(c.law.is_unique and not c.free_components for c in self.problem.contacts)
        flat = all(c["obstacle"]["kind"] == "halfspace" for c in self.scene["contacts"])
        return plain and flat and self.scene["bulk"] == "linear" and not self._slips()

    def _slips(self) -> bool:
        return any(c.law.has_friction for c in self.problem.contacts)
