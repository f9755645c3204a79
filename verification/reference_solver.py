"""An independent solver for frictional contact in NumPy, with which the package is compared.

It shares only DOLFINx's stiffness matrix and load vector with the package. Quadrature points,
normals, contact pairs and L2 projection (`reference_geometry`), contact laws (`reference_laws`),
history, static condensation and Newton's method are implemented again, with dense matrices, for
some hundred unknowns on one rank. Nodes are numbered as in the displacement element.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.linalg

from verification.reference_geometry import Body
from verification.reference_laws import Law, dot

__all__ = ["ContactModel", "Load", "NotSolved", "Problem", "State"]

Array = np.ndarray
# Step of complex-step derivatives, which have no truncation error.
_COMPLEX_STEP = 1e-60
# Reciprocal condition number above which a system is solved by LU, and else by least squares.
_MIN_RCOND = 1e-8


# ---- a contact -----------------------------------------------------------------------------------


@dataclass(eq=False)
class State:
    """Committed state of a contact.

    Attributes:
        jump: Slip reference: the relative displacement at which Δu_t = 0, (n, d) (length).
        traction: τ, or with multipliers λ_t, (n, d) (stress).
        pressure: λ_n, (n,) (stress); None without multipliers.
        bound: Prescribed friction bound, (n,) (stress); None for the bound of the law.
    """

    jump: Array
    traction: Array
    pressure: Array | None = None
    bound: Array | None = None


@dataclass(eq=False)
class ContactModel:
    """A contact at quadrature points.

    Attributes:
        x: Quadrature points of the undeformed Γc, (n, d) (length).
        gap_function: Returns gap (n,) and unit normal (n, d) for an obstacle displacement (d,).
        interpolation: Matrix from nodes to the displacement jump, (n, n_nodes).
        weights: Quadrature weights, (n,).
        k_n, k_t: Contact stiffness, (n,).
        law: The contact law.
        paired: Whether points may carry tractions, (n,).
        free_components: Components of the obstacle's motion that are unknowns.
        projection: L2 projection of the multipliers, (n, n); None without multipliers.
        update_pairs: Updates the pairs for a displacement; None if pairs are fixed.
        opposite_penetration: Integrates the penetration on the opposing surface for a
            displacement; None on a rigid obstacle.
        slave: Γc.
        facet: Facet of every point.
        deformed_gap: Returns gap and normal at points (n, d) for an obstacle displacement; None
            if the obstacle is not a rigid shape.
        radius: Radius of a round obstacle, for its round-off (length).
        centreline: Centreline of a rod in its first position, (n, d); None for other obstacles.
        current_pairs: Returns interpolation, gap and pairs of deformed bodies for u; None on a
            rigid obstacle.
    """

    x: Array
    gap_function: Any
    interpolation: Array
    weights: Array
    k_n: Array
    k_t: Array
    law: Law
    paired: Array
    free_components: tuple[int, ...] = ()
    projection: Array | None = None
    update_pairs: Any = None
    opposite_penetration: Any = None
    slave: Any = None
    facet: Any = None
    deformed_gap: Any = None
    radius: float = 0.0
    centreline: Any = None
    current_pairs: Any = None
    _cached_gap: tuple[Any, ...] = field(default=(None, b"", ()), init=False, repr=False)

    @property
    def d(self) -> int:
        """Dimension of space."""
        return int(self.x.shape[1])

    def initial_state(self) -> State:
        """Return the state without traction and slip."""
        zero = np.zeros_like(self.x)
        return State(zero, zero, None if self.projection is None else np.zeros(len(zero)))

    def jump(self, u: Array) -> Array:
        """Return the displacement jump, (n, d)."""
        return self.interpolation @ u.reshape(-1, self.d)

    def gap_and_normal(self, shift: Array) -> tuple[Array, Array]:
        """Return gap and normal; the arrays are reused until obstacle or pairs change."""
        if np.iscomplexobj(shift):
            return self.gap_function(shift)
        if self._cached_gap[0] is not self.gap_function or self._cached_gap[1] != shift.tobytes():
            self._cached_gap = self.gap_function, shift.tobytes(), self.gap_function(shift)
        return self._cached_gap[2]

    def evaluate(self, jump: Array, shift: Array, old: State) -> dict[str, Array]:
        """Return tractions and local kinematics for one jump (n, d), or for several, (m, n, d)."""
        gap, n = self.gap_and_normal(shift)
        relative = jump - shift

        def tangential(vector: Array) -> Array:
            return vector - dot(vector, n)[..., None] * n

        overclosure = dot(jump, n) - gap
        step, before = tangential(relative - old.jump), tangential(old.traction)
        total = tangential(relative) if self.law.kind == "foundation" else relative
        r_n = self.law.normal_traction(self.k_n, overclosure, old.pressure)
        tau = self.law.tangential_traction(
            self.k_t, n, step, before, total, r_n, overclosure, old.bound
        )
        r_n, tau = np.where(self.paired, r_n, 0), np.where(self.paired[:, None], tau, 0)
        traction = r_n[..., None] * n + tau
        return {
            "normal": n,
            "overclosure": overclosure,
            "relative": relative,
            "slip": step,
            "tau_old": before,
            "r_n": r_n,
            "tau": tau,
            "traction": traction,
        }

    def derivatives(
        self, jump: Array, shift: Array, old: State, motion_columns: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """Return ∂t/∂jump, (n, d, d), and ∂t/∂shift, (n, d, m) for m components of the shift."""
        steps = 1j * _COMPLEX_STEP * np.eye(self.d)
        found = self.evaluate(jump + steps[:, None], shift, old)["traction"]
        by_jump = np.moveaxis(found.imag, 0, 2) / _COMPLEX_STEP
        by_shift = np.zeros(
            (len(jump), self.d, self.d if motion_columns is None else len(motion_columns))
        )
        for k, i in enumerate(range(self.d) if motion_columns is None else motion_columns):
            found = self.evaluate(jump + 0j, shift + steps[i], old)["traction"]
            by_shift[:, :, k] = found.imag / _COMPLEX_STEP
        return by_jump, by_shift

    def initial_position(self) -> Any:
        """Return the first position of the obstacle, as an argument of `evaluate`."""
        return np.zeros(self.d)

    def centreline_at(self, shift: Any) -> Array:
        """Return the centreline of a rod, (n, d)."""
        return self.centreline + shift

    def reset_slip(self, found: dict[str, Array], old: Any, unloaded: Array) -> Any:
        """Move the slip reference of unloaded points, (n,), to an evaluated state."""
        return replace(old, jump=np.where(unloaded[:, None], found["relative"], old.jump))

    def augment(self, found: dict[str, Array], old: State) -> State:
        """Return the state after one augmentation."""
        assert self.projection is not None
        pressure = self.projection @ -found["r_n"] if self.law.has_normal else 0 * found["r_n"]
        traction = self.projection @ found["tau"] if self.law.has_friction else old.traction
        return State(old.jump, traction, pressure)

    def next_state(self, found: dict[str, Array], old: State) -> State:
        """Return the state to commit; ``old`` has the multipliers of the solution."""
        if self.projection is None:
            return State(found["relative"].copy(), found["tau"].copy())
        jump = found["relative"]
        if self.law.has_friction:
            change = found["tau_old"] - found["tau"]
            jump = jump - self.law.elastic_slip(self.k_t, found["normal"], change)
        return State(jump, old.traction.copy(), old.pressure)

    def stored_energy(self, found: dict[str, Array]) -> float:
        """Return the energy of the contact springs (penalty enforcement)."""
        w, law = self.weights * self.paired, self.law
        if law.kind == "foundation":
            tangential = (
                found["relative"]
                - np.sum(found["relative"] * found["normal"], axis=1)[:, None] * found["normal"]
            )
            energy = -found["r_n"] * found["overclosure"] - np.sum(
                found["tau"] * tangential, axis=1
            )
            return float(w @ energy / 2)
        energy = found["r_n"] ** 2 / (2 * self.k_n) if law.has_normal else 0 * found["r_n"]
        if law.has_friction:
            stretch = law.elastic_slip(self.k_t, found["normal"], found["tau"])
            energy = energy + np.sum(found["tau"] * stretch, axis=1) / 2
        return float(w @ energy)

    def dissipated_energy(self, found: dict[str, Array]) -> float:
        """Return the friction dissipation of the increment (penalty enforcement)."""
        if not self.law.has_friction:
            return 0.0
        stretch = self.law.elastic_slip(self.k_t, found["normal"], found["tau"] - found["tau_old"])
        return float(
            -(self.weights * self.paired) @ np.sum(found["tau"] * (found["slip"] + stretch), axis=1)
        )


# ---- the problem ---------------------------------------------------------------------------------


@dataclass(eq=False)
class Load:
    """Load at the end of an increment.

    Attributes:
        force: Load vector, (N,) (force).
        fixed: Dirichlet dofs.
        values: Values of the Dirichlet dofs (length).
        shifts: Prescribed displacement of the obstacle of every contact, (d,); 0 if free.
        obstacle_forces: Force on the obstacle of every contact, (d,).
    """

    force: Array
    fixed: Array
    values: Array
    shifts: list[Array]
    obstacle_forces: list[Array]


class NotSolved(RuntimeError):
    """The independent solver has not found a solution."""


class CondensedSystem:
    """A linear bulk after static condensation onto n dofs of Γc and m free obstacle motions.

    It is valid for one set of pairs and Dirichlet dofs.

    Attributes:
        retained, eliminated: Retained dofs, n, and eliminated ones.
        stiffness: Condensed stiffness, (n + m, n + m).
        stick_stiffness: Condensed stiffness with all points sticking, which is regular.
        scale: Square root of the diagonal of `stick_stiffness`.
        maps: Matrix from the n dofs to the jump of every contact, (n_points d, n).
        operators: Matrix D from all n + m unknowns to the relative displacement of every contact.
        motion_columns: Columns of the free motions of every contact, and their components.
    """

    def __init__(self, problem: Problem, fixed: Array) -> None:
        """Eliminate the free dofs that no contact couples."""
        d, K = problem.body.d, problem.body.stiffness
        self._fixed = fixed
        self._pairs = [c.interpolation for c in problem.contacts]
        coupled, constrained = (np.zeros(len(K), dtype=bool), np.zeros(len(K), dtype=bool))
        for pairs in self._pairs:
            coupled |= np.repeat(np.any(pairs != 0, axis=0), d)
        constrained[fixed] = True
        self.retained = np.flatnonzero(coupled & ~constrained)
        self.eliminated = np.flatnonzero(~coupled & ~constrained)
        self._K_fixed = K[:, fixed]
        schur = K[np.ix_(self.retained, self.retained)]
        if len(self.eliminated):
            self._factor = scipy.linalg.cho_factor(K[np.ix_(self.eliminated, self.eliminated)])
            self._coupling = K[np.ix_(self.eliminated, self.retained)]
            self._extension = scipy.linalg.cho_solve(self._factor, self._coupling)
            schur = schur - self._coupling.T @ self._extension
        free = problem.free_motions()
        self.stiffness = scipy.linalg.block_diag(schur, np.zeros((len(free),) * 2))
        self.stick_stiffness = self.stiffness.copy()
        self.maps, self.operators, self.motion_columns, self._fixed_jumps = ([], [], [], [])
        for c, model in enumerate(problem.contacts):
            whole = np.kron(model.interpolation, np.eye(d))
            mine = [len(self.retained) + k for k, (o, _) in enumerate(free) if o == c]
            axes = [i for o, i in free if o == c]
            D = np.zeros((model.x.size, len(self.stiffness)))
            D[:, : len(self.retained)] = whole[:, self.retained]
            D[:, mine] = -np.tile(np.eye(d)[:, axes], (len(model.x), 1))
            self.maps.append(whole[:, self.retained])
            self.operators.append(D)
            self.motion_columns.append((mine, axes))
            self._fixed_jumps.append(whole[:, fixed])
            springs = np.where(model.k_t > 0, model.k_t, model.k_n)
            springs = model.weights * np.maximum(model.k_n, springs)
            self.stick_stiffness += D.T @ (np.repeat(springs, d)[:, None] * D)
        self.scale = np.sqrt(np.maximum(np.abs(np.diag(self.stick_stiffness)), 1e-300))
        self._sizes = (np.abs(self.stiffness), [np.abs(D) for D in self.operators])
        self._load: Load | None = None

    def is_valid_for(self, problem: Problem, fixed: Array) -> bool:
        """Whether pairs and Dirichlet dofs are unchanged."""
        pairs = zip(problem.contacts, self._pairs, strict=True)
        return all(c.interpolation is p for c, p in pairs) and np.array_equal(fixed, self._fixed)

    def condense_load(self, load: Load) -> tuple[Array, list[Array]]:
        """Return the condensed load, and the jumps due to the Dirichlet values alone."""
        if load is not self._load:
            right = load.force - self._K_fixed @ load.values
            force = right[self.retained]
            if len(self.eliminated):
                self._interior = scipy.linalg.cho_solve(self._factor, right[self.eliminated])
                force = force - self._coupling.T @ self._interior
            axes = [(c, i) for c, (_, own) in enumerate(self.motion_columns) for i in own]
            force = np.concatenate([force, [load.obstacle_forces[c][i] for c, i in axes]])
            self._reduced = force, [t @ load.values for t in self._fixed_jumps]
            self._load = load
        return self._reduced

    def recover(self, u: Array, retained: Array) -> None:
        """Set the retained dofs in u, and recover the eliminated ones for the last load."""
        u[self.retained] = retained
        if len(self.eliminated):
            u[self.eliminated] = self._interior - self._extension @ retained

    def roundoff(self, z: Array, forces: list[Array]) -> float:
        """Return the norm of the terms of the residual, to which its round-off is relative."""
        K, D = self._sizes
        total = K @ np.abs(z)
        for tangential, force in zip(D, forces, strict=True):
            total += np.abs(force) @ tangential
        return _norm(total)

    def step(self, matrix: Array, residual: Array) -> Array:
        """Return the Newton step, with the sticking stiffness if the tangent is singular."""
        system = matrix / self.scale[:, None] / self.scale
        right = -residual / self.scale
        size = np.abs(system).sum(axis=0).max(initial=0.0)
        factor, order, singular = scipy.linalg.lapack.dgetrf(system)
        if not singular and scipy.linalg.lapack.dgecon(factor, size)[0] > _MIN_RCOND:
            return scipy.linalg.lapack.dgetrs(factor, order, right)[0] / self.scale
        if np.linalg.cond(system) > 1e13:
            system = self.stick_stiffness / self.scale[:, None] / self.scale
        return np.linalg.lstsq(system, right, rcond=1e-15)[0] / self.scale


@dataclass(eq=False)
class Trial:
    """A trial state of Newton's method.

    Attributes:
        z: The n + m unknowns of `CondensedSystem`.
        residual: Residual of these unknowns.
        size: The largest force.
        jumps, shifts, forces: Jump, obstacle displacement and force of every contact.
    """

    z: Array
    residual: Array
    size: float
    jumps: list[Array]
    shifts: list[Array]
    forces: list[Array]


def _norm(vector: Array) -> float:
    return math.sqrt(vector @ vector)


def _multiplier_change(new: list[State], old: list[State]) -> tuple[float, float]:
    """Return the largest change of multipliers, and the largest multiplier (stress)."""
    change = scale = 0.0
    for a, b in zip(new, old, strict=True):
        if a.pressure is not None:
            change = max(change, np.abs(a.pressure - b.pressure).max())
            change = max(change, np.abs(a.traction - b.traction).max())
            scale = max(scale, np.abs(a.pressure).max(), np.abs(a.traction).max())
    return change, scale


@dataclass(eq=False)
class Problem:
    """A linear bulk with contacts.

    Attributes:
        body: The bulk.
        contacts: The contacts.
        largest_translation: Translation of all bodies, for the round-off of gaps (length).
    """

    body: Body
    contacts: list[ContactModel]
    largest_translation: float = 0.0
    _condensed: CondensedSystem | None = field(default=None, init=False, repr=False)

    def free_motions(self) -> list[tuple[int, int]]:
        """Return contact and component of every free obstacle motion."""
        return [(c, i) for c, m in enumerate(self.contacts) for i in m.free_components]

    def shifts(self, load: Load, motion: Array) -> list[Array]:
        """Return the displacements of the obstacles."""
        shifts = [np.array(s, dtype=motion.dtype) for s in load.shifts]
        for value, (c, i) in zip(motion, self.free_motions(), strict=False):
            shifts[c][i] = value
        return shifts

    def evaluate(self, u: Array, motion: Array, load: Load, old: list[State]) -> list[dict]:
        """Evaluate all contacts."""
        shifts = self.shifts(load, motion)
        return [
            c.evaluate(c.jump(u), s, o) for c, s, o in zip(self.contacts, shifts, old, strict=True)
        ]

    def contact_force(self, found: list[dict]) -> list[Array]:
        """Return the force of every contact on the bodies, (N,) each."""
        return [
            (c.interpolation.T @ (c.weights[:, None] * f["traction"])).ravel()
            for c, f in zip(self.contacts, found, strict=True)
        ]

    def stiffness(self, u: Array) -> Array:
        """Return the tangent stiffness of the bulk."""
        return self.body.stiffness

    def residual(self, u: Array, load: Load, found: list[dict]) -> tuple[Array, Array]:
        """Return the residual of all dofs, and that of the free obstacle motions."""
        total = self.body.stiffness @ u - load.force - sum(self.contact_force(found))
        motion = [
            (self.contacts[c].weights @ found[c]["traction"])[i] - load.obstacle_forces[c][i]
            for c, i in self.free_motions()
        ]
        return total, np.array(motion)

    def solve(
        self, u: Array, motion: Array, load: Load, old: list[State], *, rtol: float = 1e-12
    ) -> tuple[Array, Array, list[State]]:
        """Solve one increment, with augmentations if there are multipliers.

        Args:
            u: Initial guess of the displacement.
            motion: Initial guess of the free motions.
            load: Load at the end of the increment.
            old: Committed states.
            rtol: Residual relative to the forces.

        Returns:
            u, motions, and the committed states with the multipliers of the solution.

        Raises:
            NotSolved: The iteration does not converge.
        """
        if all(c.projection is None for c in self.contacts):
            return *self.equilibrate(u, motion, load, old, rtol), old
        for _ in range(3000):
            u, motion = self.equilibrate(u, motion, load, old, rtol)
            found = self.evaluate(u, motion, load, old)
            new = [
                c.augment(f, o) if c.projection is not None else o
                for c, f, o in zip(self.contacts, found, old, strict=True)
            ]
            change, scale = _multiplier_change(new, old)
            old = new
            if change <= 1e-9 * scale + self.traction_roundoff():
                return u, motion, old
        raise NotSolved("multipliers do not converge")

    def traction_roundoff(self) -> float:
        """Return the round-off of tractions due to the translation of the bodies (stress)."""
        K = max(float((c.k_n + c.k_t).max()) for c in self.contacts)
        return 16 * float(np.finfo(float).eps) * K * self.largest_translation

    def equilibrate(
        self, u: Array, motion: Array, load: Load, old: list[State], rtol: float
    ) -> tuple[Array, Array]:
        """Solve by Newton's method; if it fails, restart from a sequence of Tresca problems."""
        try:
            return self._newton(u, motion, load, old, rtol)
        except (NotSolved, np.linalg.LinAlgError) as failure:
            if all(c.law.is_unique for c in self.contacts):
                raise
            last = failure
        old_pressures = [np.zeros(len(c.x)) for c in self.contacts]
        for attempt in range(25):
            frozen = [
                replace(o, bound=c.law.friction * p if c.law.kind == "coulomb" else None)
                for c, o, p in zip(self.contacts, old, old_pressures, strict=True)
            ]
            u, motion = self._newton(u, motion, load, frozen, rtol)
            found = self.evaluate(u, motion, load, frozen)
            old_pressures = [-f["r_n"] for f in found]
            if attempt in (2, 5, 10, 24):
                with contextlib.suppress(NotSolved):
                    return self._newton(u, motion, load, old, rtol)
        raise last

    def _condense(self, fixed: Array) -> CondensedSystem:
        if self._condensed is None or not self._condensed.is_valid_for(self, fixed):
            self._condensed = CondensedSystem(self, fixed)
        return self._condensed

    def _tangent(self, condensed: CondensedSystem, at: Trial, old: list[State]) -> Array:
        """Return the derivative of the condensed residual."""
        d, matrix = self.body.d, condensed.stiffness.copy()
        for c, model in enumerate(self.contacts):
            mine, axes = condensed.motion_columns[c]
            by_jump, by_shift = model.derivatives(at.jumps[c], at.shifts[c], old[c], axes)
            w, maps = model.weights[:, None, None], condensed.maps[c]
            coupled = ((w * by_jump) @ maps.reshape(-1, d, maps.shape[1])).reshape(maps.shape)
            matrix[:, : maps.shape[1]] -= condensed.operators[c].T @ coupled
            if mine:
                turned = (w * by_shift).reshape(-1, len(axes))
                matrix[:, mine] -= condensed.operators[c].T @ turned
        return matrix

    def _newton(
        self, u: Array, motion: Array, load: Load, old: list[State], rtol: float
    ) -> tuple[Array, Array]:
        """Solve the condensed equations by Newton's method with a line search."""
        condensed = self._condense(load.fixed)
        outside, rigid = condensed.condense_load(load)
        d, n = self.body.d, len(condensed.retained)
        load_norm = _norm(outside[:n])

        def evaluate(z: Array) -> Trial:
            inside = condensed.stiffness @ z
            residual, size = inside - outside, max(load_norm, _norm(inside))
            shifts, jumps, forces = self.shifts(load, z[n:]), [], []
            for c, model in enumerate(self.contacts):
                jump = (condensed.maps[c] @ z[:n] + rigid[c]).reshape(-1, d)
                traction = model.evaluate(jump, shifts[c], old[c])["traction"]
                force = (model.weights[:, None] * traction).ravel()
                total = force @ condensed.operators[c]
                residual -= total
                size = max(size, _norm(total[:n]))
                jumps.append(jump)
                forces.append(force)
            return Trial(z, residual, size, jumps, shifts, forces)

        convex = not self.free_motions() and all(
            c.law.is_unique or (o.bound is not None and c.law.kind == "coulomb")
            for c, o in zip(self.contacts, old, strict=True)
        )
        now = evaluate(np.concatenate([u[condensed.retained], motion]))
        best, since = (np.inf, now), 0
        for iteration in range(200):
            norm = _norm(now.residual)
            if norm < best[0]:
                since = iteration if norm < 0.5 * best[0] else since
                best = (norm, now)
            if norm <= rtol * now.size or norm <= 1e-14 * condensed.roundoff(now.z, now.forces):
                break
            if iteration > since + 40:
                break
            step = condensed.step(self._tangent(condensed, now, old), now.residual)
            share, slope = 1.0, now.residual @ step
            low, high = (0.0, slope), None
            first = _norm(now.residual / condensed.scale)
            # As in the source paper the line search finds a zero of the energy's slope.
            # The step is doubled as long as an unconstrained body has not met its obstacle.
            for _ in range(60):
                trial, tried = evaluate(now.z + share * step), share
                lower = _norm(trial.residual / condensed.scale) < (1 - 0.1 * share) * first
                if lower and not convex:
                    break
                along = trial.residual @ step
                if abs(along) <= 0.3 * abs(slope):
                    break
                if along < 0:
                    low = (share, along)
                else:
                    high = (share, along)
                if high is None:
                    share *= 2.0
                else:
                    part = low[1] / (low[1] - high[1])
                    share = low[0] + np.clip(part, 0.1, 0.9) * (high[0] - low[0])
            if iteration % 9 == 8 and not convex:
                share = 1.0 if iteration % 18 == 8 else 0.37  # leaves a cycle
            now = trial if share == tried else evaluate(now.z + share * step)
        norm, now = best
        # Neither large internal forces nor round-off excuse a residual above 1e-3 of the load.
        limits = rtol * now.size, 1e-14 * condensed.roundoff(now.z, now.forces)
        excused = max(1e3 * limits[0], 1e2 * limits[1])
        if norm > max(min(excused, 1e-3 * _norm(load.force) or np.inf), *limits):
            raise NotSolved(f"residual {norm / max(now.size, 1e-300):.1e} of the forces")
        u = u.copy()
        u[load.fixed] = load.values
        condensed.recover(u, now.z[:n])
        return u, now.z[n:].copy()
