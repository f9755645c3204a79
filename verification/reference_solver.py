"""A second solution of frictional contact in plain NumPy, to judge the package by.

It shares nothing with the package but DOLFINx's stiffness and load vector: points, weights and
normals of Γc, pairs of surfaces and L2 projection (`reference_geometry`), laws (`reference_laws`),
history, condensation and solver (here) are made anew, dense and by brute force, for problems of
some hundred unknowns. What is solved is what the package's docstrings define: laws at quadrature
points (`laws`), obstacles (`obstacles`), pairs (`pairing`), multipliers (`multipliers`).

Arrays are those of one rank. Numbers of nodes are those of the displacement element.
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

__all__ = ["ContactModel", "Failed", "Load", "Problem", "State"]

Array = np.ndarray
# Step of the derivatives by complex numbers: exact, whatever its size.
_STEP = 1e-60
# Systems whose condition is better than its inverse are solved by elimination.
_WELL = 1e-8


# ---- a contact -----------------------------------------------------------------------------------


@dataclass(eq=False)
class State:
    """What a contact keeps from one increment to the next.

    Attributes:
        jump: Displacement relative to the obstacle that Δu_t counts from, (n, d) (length).
        traction: τ, or with multipliers λ_t, (n, d) (stress).
        pressure: λ_n, (n,) (stress); None without multipliers.
        limit: Of friction, where it is taken for given, (n,) (stress).
    """

    jump: Array
    traction: Array
    pressure: Array | None = None
    limit: Array | None = None


@dataclass(eq=False)
class ContactModel:
    """Γc, its obstacle and its law at points.

    Attributes:
        place: Function of the shift of the obstacle, (d,): gap (n,) and unit normal (n, d).
        interpolation: From node values to the body's displacement, less the opposite one,
            (n_points, n_nodes).
        weights: (n,).
        k_n, k_t: Stiffness at the points, (n,).
        law: The law.
        paired: Points that may carry tractions, (n,).
        free: Components of the obstacle's motion that follow from the force on it.
        project: L2 projection of the multipliers, (n, n); None without multipliers.
        repair: Pairs the points anew at a displacement; None where pairs stay.
        back: ∫ of the penetration as the opposite surface sees it at a displacement; None where
            the obstacle is rigid.
        here: Γc.
        facet: On it, of every point.
        near: Function of places (n, d) and where the obstacle is: distance (n,) and minus its
            gradient (n, d); None where the obstacle is no rigid shape.
        radius: Of a round obstacle, whose round-off gaps have (length).
        spine: Middle line of a rod where it began, (n, d); None of other obstacles.
        anew: Function of u: interpolation, gap and pairs of bodies where they have moved to; None
            where the obstacle is rigid.
    """

    x: Array
    place: Any
    interpolation: Array
    weights: Array
    k_n: Array
    k_t: Array
    law: Law
    paired: Array
    free: tuple[int, ...] = ()
    project: Array | None = None
    repair: Any = None
    back: Any = None
    here: Any = None
    facet: Any = None
    near: Any = None
    radius: float = 0.0
    spine: Any = None
    anew: Any = None
    _placed: tuple[Any, ...] = field(default=(None, b"", ()), init=False, repr=False)

    @property
    def d(self) -> int:
        """Dimension."""
        return int(self.x.shape[1])

    def start(self) -> State:
        """No traction, no slip."""
        zero = np.zeros_like(self.x)
        return State(zero, zero, None if self.project is None else np.zeros(len(zero)))

    def jump(self, u: Array) -> Array:
        """Displacement of the body, less that of the opposite one, (n, d)."""
        return self.interpolation @ u.reshape(-1, self.d)

    def placed(self, shift: Array) -> tuple[Array, Array]:
        """Gap and normal; the same arrays until the obstacle moves or the pairs change."""
        if np.iscomplexobj(shift):
            return self.place(shift)
        if self._placed[0] is not self.place or self._placed[1] != shift.tobytes():
            self._placed = self.place, shift.tobytes(), self.place(shift)
        return self._placed[2]

    def respond(self, jump: Array, shift: Array, old: State) -> dict[str, Array]:
        """Tractions and what they follow from; of one jump (n, d), or of several, (m, n, d)."""
        gap, n = self.placed(shift)
        relative = jump - shift

        def across(vector: Array) -> Array:
            return vector - dot(vector, n)[..., None] * n

        closing = dot(jump, n) - gap
        step, before = across(relative - old.jump), across(old.traction)
        total = across(relative) if self.law.kind == "foundation" else relative
        r_n = self.law.normal(self.k_n, closing, old.pressure)
        tau = self.law.tangential(self.k_t, n, step, before, total, r_n, closing, old.limit)
        r_n, tau = np.where(self.paired, r_n, 0), np.where(self.paired[:, None], tau, 0)
        traction = r_n[..., None] * n + tau
        return {
            "normal": n,
            "closing": closing,
            "relative": relative,
            "step": step,
            "before": before,
            "r_n": r_n,
            "tau": tau,
            "traction": traction,
        }

    def derivatives(
        self, jump: Array, shift: Array, old: State, moves: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """∂t/∂jump, (n, d, d), and ∂t/∂shift, (n, d, m); the last index is the component.

        ``moves``: components of the shift that are asked for; by default all of them.
        """
        turns = 1j * _STEP * np.eye(self.d)
        found = self.respond(jump + turns[:, None], shift, old)["traction"]
        by_jump = np.moveaxis(found.imag, 0, 2) / _STEP
        by_shift = np.zeros((len(jump), self.d, self.d if moves is None else len(moves)))
        for k, i in enumerate(range(self.d) if moves is None else moves):
            found = self.respond(jump + 0j, shift + turns[i], old)["traction"]
            by_shift[:, :, k] = found.imag / _STEP
        return by_jump, by_shift

    def at_rest(self) -> Any:
        """Where the obstacle began, as `respond` takes it."""
        return np.zeros(self.d)

    def spine_at(self, shift: Any) -> Array:
        """The middle line of a rod, (n, d)."""
        return self.spine + shift

    def counted_from(self, found: dict[str, Array], old: Any, idle: Array) -> Any:
        """History with slip of some points, (n,), counted from a state that is not committed."""
        return replace(old, jump=np.where(idle[:, None], found["relative"], old.jump))

    def augment(self, found: dict[str, Array], old: State) -> State:
        """One round: the multipliers that the tractions found make."""
        assert self.project is not None
        pressure = self.project @ -found["r_n"] if self.law.has_normal else 0 * found["r_n"]
        traction = self.project @ found["tau"] if self.law.slips else old.traction
        return State(old.jump, traction, pressure)

    def next_state(self, found: dict[str, Array], old: State) -> State:
        """History of the next increment; ``old`` with the multipliers it was found with."""
        if self.project is None:
            return State(found["relative"].copy(), found["tau"].copy())
        jump = found["relative"]
        if self.law.slips:
            borne = found["before"] - found["tau"]
            jump = jump - self.law.stretch(self.k_t, found["normal"], borne)
        return State(jump, old.traction.copy(), old.pressure)

    def stored(self, found: dict[str, Array]) -> float:
        """Energy of the springs, of penalty enforcement."""
        w, law = self.weights * self.paired, self.law
        if law.kind == "foundation":
            across = (
                found["relative"]
                - np.sum(found["relative"] * found["normal"], axis=1)[:, None] * found["normal"]
            )
            energy = -found["r_n"] * found["closing"] - np.sum(found["tau"] * across, axis=1)
            return float(w @ energy / 2)
        energy = found["r_n"] ** 2 / (2 * self.k_n) if law.has_normal else 0 * found["r_n"]
        if law.slips:
            stretch = law.stretch(self.k_t, found["normal"], found["tau"])
            energy = energy + np.sum(found["tau"] * stretch, axis=1) / 2
        return float(w @ energy)

    def dissipated(self, found: dict[str, Array]) -> float:
        """Work of friction on the slip of the increment, of penalty enforcement."""
        if not self.law.slips:
            return 0.0
        stretch = self.law.stretch(self.k_t, found["normal"], found["tau"] - found["before"])
        return float(
            -(self.weights * self.paired) @ np.sum(found["tau"] * (found["step"] + stretch), axis=1)
        )


# ---- the problem ---------------------------------------------------------------------------------


@dataclass(eq=False)
class Load:
    """What drives an increment.

    Attributes:
        force: Load vector, (N,) (force).
        fixed: Prescribed unknowns.
        values: Theirs (length).
        shifts: Of every contact the prescribed displacement of its obstacle, (d,); zero where free.
        pushes: Of every contact the force on its obstacle, (d,).
    """

    force: Array
    fixed: Array
    values: Array
    shifts: list[Array]
    pushes: list[Array]


class Failed(RuntimeError):
    """No solution was found here."""


class Reduced:
    """A linear problem on the unknowns of Γc and the free motions, the others eliminated.

    It holds while the pairs and the prescribed unknowns are the same.

    Attributes:
        kept, inner: Numbers of the unknowns of Γc that are free, n, and of those eliminated.
        stiffness: Of these n unknowns, then of m free motions, (n + m, n + m).
        closed: With all of Γc closed and sticking, to hold what nothing holds yet.
        scale: Root of the diagonal of that.
        maps: Of every contact, from the n unknowns to jumps, (n_points d, n).
        left: From all n + m unknowns to jumps less shifts, (n_points d, n + m).
        moves: Of every contact the columns of its motions there, and their components.
    """

    def __init__(self, problem: Problem, fixed: Array) -> None:
        """Eliminate what is neither on Γc nor prescribed."""
        d, stiff = problem.body.d, problem.body.stiffness
        self._fixed = fixed
        self._pairs = [c.interpolation for c in problem.contacts]
        felt, held = np.zeros(len(stiff), dtype=bool), np.zeros(len(stiff), dtype=bool)
        for pairs in self._pairs:
            felt |= np.repeat(np.any(pairs != 0, axis=0), d)
        held[fixed] = True
        self.kept, self.inner = np.flatnonzero(felt & ~held), np.flatnonzero(~felt & ~held)
        self._dragged = stiff[:, fixed]
        schur = stiff[np.ix_(self.kept, self.kept)]
        if len(self.inner):
            self._factor = scipy.linalg.cho_factor(stiff[np.ix_(self.inner, self.inner)])
            self._across = stiff[np.ix_(self.inner, self.kept)]
            self._recover = scipy.linalg.cho_solve(self._factor, self._across)
            schur = schur - self._across.T @ self._recover
        free = problem.motions()
        self.stiffness = scipy.linalg.block_diag(schur, np.zeros((len(free),) * 2))
        self.closed = self.stiffness.copy()
        self.maps, self.left, self.moves, self._ties = [], [], [], []
        for c, model in enumerate(problem.contacts):
            whole = np.kron(model.interpolation, np.eye(d))
            mine = [len(self.kept) + k for k, (o, _) in enumerate(free) if o == c]
            axes = [i for o, i in free if o == c]
            left = np.zeros((model.x.size, len(self.stiffness)))
            left[:, : len(self.kept)] = whole[:, self.kept]
            left[:, mine] = -np.tile(np.eye(d)[:, axes], (len(model.x), 1))
            self.maps.append(whole[:, self.kept])
            self.left.append(left)
            self.moves.append((mine, axes))
            self._ties.append(whole[:, fixed])
            springs = np.where(model.k_t > 0, model.k_t, model.k_n)
            springs = model.weights * np.maximum(model.k_n, springs)
            self.closed += left.T @ (np.repeat(springs, d)[:, None] * left)
        self.scale = np.sqrt(np.maximum(np.abs(np.diag(self.closed)), 1e-300))
        self._sizes = np.abs(self.stiffness), [np.abs(left) for left in self.left]
        self._load: Load | None = None

    def holds(self, problem: Problem, fixed: Array) -> bool:
        """Whether it is still this problem."""
        pairs = zip(problem.contacts, self._pairs, strict=True)
        return all(c.interpolation is p for c, p in pairs) and np.array_equal(fixed, self._fixed)

    def take(self, load: Load) -> tuple[Array, list[Array]]:
        """Forces on the n + m unknowns; jumps of what is prescribed alone, of every contact."""
        if load is not self._load:
            right = load.force - self._dragged @ load.values
            force = right[self.kept]
            if len(self.inner):
                self._first = scipy.linalg.cho_solve(self._factor, right[self.inner])
                force = force - self._across.T @ self._first
            pushes = [load.pushes[c][i] for c, (_, axes) in enumerate(self.moves) for i in axes]
            self._taken = np.concatenate([force, pushes]), [t @ load.values for t in self._ties]
            self._load = load
        return self._taken

    def fill(self, u: Array, kept: Array) -> None:
        """Set the kept unknowns, and those eliminated, of the load taken last."""
        u[self.kept] = kept
        if len(self.inner):
            u[self.inner] = self._first - self._recover @ kept

    def floor(self, z: Array, forces: list[Array]) -> float:
        """Size of all that the residual is summed of: rounding is a share of this."""
        stiff, left = self._sizes
        total = stiff @ np.abs(z)
        for across, force in zip(left, forces, strict=True):
            total += np.abs(force) @ across
        return _norm(total)

    def step(self, matrix: Array, rest: Array) -> Array:
        """Newton's step; that of closed springs where nothing holds the bodies."""
        system = matrix / self.scale[:, None] / self.scale
        right = -rest / self.scale
        size = np.abs(system).sum(axis=0).max(initial=0.0)
        factor, order, singular = scipy.linalg.lapack.dgetrf(system)
        if not singular and scipy.linalg.lapack.dgecon(factor, size)[0] > _WELL:
            return scipy.linalg.lapack.dgetrs(factor, order, right)[0] / self.scale
        if np.linalg.cond(system) > 1e13:
            system = self.closed / self.scale[:, None] / self.scale
        return np.linalg.lstsq(system, right, rcond=1e-15)[0] / self.scale


@dataclass(eq=False)
class Trial:
    """A place of Newton's method.

    Attributes:
        z: The n + m unknowns of `Reduced`.
        rest: Residual of these.
        size: The largest force.
        jumps, shifts, forces: Of every contact.
    """

    z: Array
    rest: Array
    size: float
    jumps: list[Array]
    shifts: list[Array]
    forces: list[Array]


def _norm(vector: Array) -> float:
    return math.sqrt(vector @ vector)


def _change(new: list[State], old: list[State]) -> tuple[float, float]:
    """Largest change of multipliers, and the largest of them (stress)."""
    change = scale = 0.0
    for a, b in zip(new, old, strict=True):
        if a.pressure is not None:
            change = max(change, np.abs(a.pressure - b.pressure).max())
            change = max(change, np.abs(a.traction - b.traction).max())
            scale = max(scale, np.abs(a.pressure).max(), np.abs(a.traction).max())
    return change, scale


@dataclass(eq=False)
class Problem:
    """A linear bulk and contacts, dense.

    Attributes:
        body: The bulk.
        contacts: The contacts.
        far: How far all bodies are carried (length), of which gaps have a round-off.
    """

    body: Body
    contacts: list[ContactModel]
    far: float = 0.0
    _reduced: Reduced | None = field(default=None, init=False, repr=False)

    def motions(self) -> list[tuple[int, int]]:
        """Contact and component of every free motion."""
        return [(c, i) for c, m in enumerate(self.contacts) for i in m.free]

    def shifts(self, load: Load, motion: Array) -> list[Array]:
        """Displacements of the obstacles."""
        shifts = [np.array(s, dtype=motion.dtype) for s in load.shifts]
        for value, (c, i) in zip(motion, self.motions(), strict=False):
            shifts[c][i] = value
        return shifts

    def respond(self, u: Array, motion: Array, load: Load, old: list[State]) -> list[dict]:
        """Tractions of all contacts."""
        shifts = self.shifts(load, motion)
        return [
            c.respond(c.jump(u), s, o) for c, s, o in zip(self.contacts, shifts, old, strict=True)
        ]

    def contact_force(self, found: list[dict]) -> list[Array]:
        """Force of every contact on the bodies, (N,) each."""
        return [
            (c.interpolation.T @ (c.weights[:, None] * f["traction"])).ravel()
            for c, f in zip(self.contacts, found, strict=True)
        ]

    def stiffness(self, u: Array) -> Array:
        """K, that at a displacement."""
        return self.body.stiffness

    def residual(self, u: Array, load: Load, found: list[dict]) -> tuple[Array, Array]:
        """K u - f - contact on all unknowns, and force on obstacles not balanced."""
        total = self.body.stiffness @ u - load.force - sum(self.contact_force(found))
        motion = [
            (self.contacts[c].weights @ found[c]["traction"])[i] - load.pushes[c][i]
            for c, i in self.motions()
        ]
        return total, np.array(motion)

    def solve(
        self, u: Array, motion: Array, load: Load, old: list[State], *, rtol: float = 1e-12
    ) -> tuple[Array, Array, list[State]]:
        """One increment.

        Args:
            u: Where to start.
            motion: Likewise.
            load: At the end of the increment.
            old: History.
            rtol: Residual relative to the forces.

        Returns:
            u, motions, and the history with the multipliers that belong to the solution.

        Raises:
            Failed: Nothing was found.
        """
        if all(c.project is None for c in self.contacts):
            return *self.increment_of(u, motion, load, old, rtol), old
        for _ in range(3000):
            u, motion = self.increment_of(u, motion, load, old, rtol)
            found = self.respond(u, motion, load, old)
            new = [
                c.augment(f, o) if c.project is not None else o
                for c, f, o in zip(self.contacts, found, old, strict=True)
            ]
            change, scale = _change(new, old)
            old = new
            if change <= 1e-9 * scale + self.rounding():
                return u, motion, old
        raise Failed("multipliers do not settle")

    def rounding(self) -> float:
        """Of tractions, by how far bodies are carried (stress)."""
        stiff = max(float((c.k_n + c.k_t).max()) for c in self.contacts)
        return 16 * float(np.finfo(float).eps) * stiff * self.far

    def increment_of(
        self, u: Array, motion: Array, load: Load, old: list[State], rtol: float
    ) -> tuple[Array, Array]:
        """Newton's method; where it fails, from where limits of friction have been led to rest."""
        try:
            return self._newton(u, motion, load, old, rtol)
        except (Failed, np.linalg.LinAlgError) as failure:
            if all(c.law.unique for c in self.contacts):
                raise
            last = failure
        pressures = [np.zeros(len(c.x)) for c in self.contacts]
        for attempt in range(25):
            frozen = [
                replace(o, limit=c.law.friction * p if c.law.kind == "coulomb" else None)
                for c, o, p in zip(self.contacts, old, pressures, strict=True)
            ]
            u, motion = self._newton(u, motion, load, frozen, rtol)
            found = self.respond(u, motion, load, frozen)
            pressures = [-f["r_n"] for f in found]
            if attempt in (2, 5, 10, 24):
                with contextlib.suppress(Failed):
                    return self._newton(u, motion, load, old, rtol)
        raise last

    def _reduce(self, fixed: Array) -> Reduced:
        if self._reduced is None or not self._reduced.holds(self, fixed):
            self._reduced = Reduced(self, fixed)
        return self._reduced

    def _tangent(self, reduced: Reduced, at: Trial, old: list[State]) -> Array:
        """Derivative of the residual."""
        d, matrix = self.body.d, reduced.stiffness.copy()
        for c, model in enumerate(self.contacts):
            mine, axes = reduced.moves[c]
            by_jump, by_shift = model.derivatives(at.jumps[c], at.shifts[c], old[c], axes)
            w, maps = model.weights[:, None, None], reduced.maps[c]
            felt = ((w * by_jump) @ maps.reshape(-1, d, maps.shape[1])).reshape(maps.shape)
            matrix[:, : maps.shape[1]] -= reduced.left[c].T @ felt
            if mine:
                turned = (w * by_shift).reshape(-1, len(axes))
                matrix[:, mine] -= reduced.left[c].T @ turned
        return matrix

    def _newton(
        self, u: Array, motion: Array, load: Load, old: list[State], rtol: float
    ) -> tuple[Array, Array]:
        """Newton's method on the unknowns of Γc, the others eliminated."""
        reduced = self._reduce(load.fixed)
        outside, rigid = reduced.take(load)
        d, n = self.body.d, len(reduced.kept)
        given = _norm(outside[:n])

        def evaluate(z: Array) -> Trial:
            inside = reduced.stiffness @ z
            rest, size = inside - outside, max(given, _norm(inside))
            shifts, jumps, forces = self.shifts(load, z[n:]), [], []
            for c, model in enumerate(self.contacts):
                jump = (reduced.maps[c] @ z[:n] + rigid[c]).reshape(-1, d)
                traction = model.respond(jump, shifts[c], old[c])["traction"]
                force = (model.weights[:, None] * traction).ravel()
                total = force @ reduced.left[c]
                rest -= total
                size = max(size, _norm(total[:n]))
                jumps.append(jump)
                forces.append(force)
            return Trial(z, rest, size, jumps, shifts, forces)

        convex = not self.motions() and all(
            c.law.unique or (o.limit is not None and c.law.kind == "coulomb")
            for c, o in zip(self.contacts, old, strict=True)
        )
        now = evaluate(np.concatenate([u[reduced.kept], motion]))
        best, since = (np.inf, now), 0
        for iteration in range(200):
            norm = _norm(now.rest)
            if norm < best[0]:
                since = iteration if norm < 0.5 * best[0] else since
                best = (norm, now)
            if norm <= rtol * now.size or norm <= 1e-14 * reduced.floor(now.z, now.forces):
                break
            if iteration > since + 40:
                break
            step = reduced.step(self._tangent(reduced, now, old), now.rest)
            share, slope = 1.0, now.rest @ step
            low, high = (0.0, slope), None
            first = _norm(now.rest / reduced.scale)
            # The paper's line search: the energy, of laws that have one, is least where its slope
            # along the step is zero. Nothing holds an open body: the share is doubled until
            # something does.
            for _ in range(60):
                trial, tried = evaluate(now.z + share * step), share
                lower = _norm(trial.rest / reduced.scale) < (1 - 0.1 * share) * first
                if lower and not convex:
                    break
                along = trial.rest @ step
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
                share = 1.0 if iteration % 18 == 8 else 0.37  # out of a cycle
            now = trial if share == tried else evaluate(now.z + share * step)
        norm, now = best
        if norm > 1e3 * rtol * now.size and norm > 1e-12 * reduced.floor(now.z, now.forces):
            raise Failed(f"residual {norm / max(now.size, 1e-300):.1e} of the forces")
        u = u.copy()
        u[load.fixed] = load.values
        reduced.fill(u, now.z[:n])
        return u, now.z[n:].copy()
