"""Judges what the package found in a scene, increment by increment, by the reference solver.

Two histories are kept. One follows the package's own displacements: its laws, forces and results
are made anew from these, so that nothing but the equations is asked, however many solutions there
are. The other is solved apart, from nothing; where it differs, the package's is wrong if the laws
leave one solution only, and "another solution" else.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.spatial
import scipy.spatial.distance

from verification import fuzz_models, fuzz_scenes
from verification import reference_solver as reference

__all__ = ["UNRESISTED", "Judge", "along"]

Array = np.ndarray

# Residual in units of what the solver was asked for: SNES stops below 1, the verdict passes 2; the
# norms here are per body, so that those of all bodies together may be larger by some.
_RESIDUAL = 30.0
# Of the displacement before, what of it the sum with a step may leave.
_STEPPED = 16 * np.finfo(float).eps
# Share of K u that rounding may leave.
_ROUNDING = 1000 * np.finfo(float).eps
# Results that are sums over the points, made twice from the same u.
_SAME = 1e-9
# Integrals between facets of slope 1 against each other. Measured: two bodies bent by 2e-6 to 2e-4
# differ by up to 3 times the square of their slope.
_CURVED = 5.0
# E/h is smoothed over Γc by rational integrands where quadrilaterals are no parallelograms, whose
# quadrature is another here. Measured: 1.4e-8 of the pressure.
_SMOOTHED, _K = 1e-7, ("k_n", "k_t")
# Penetration that multipliers may leave, by the size of Γc.
_INSIDE = 1e-2
# How well bodies are set down, by their size, and how rigidly, by their way.
_DOWN, _ROUND_OFF = 1e-6, 1e-13
# Penetration between points, beyond what these resist, by the length of a facet. The package allows
# 15 % where tangent planes explain it, and 2 % for the rule.
UNRESISTED = 0.2
# Change of the contact force where geometry is taken at the deformed places; the package refuses it
# from 20 % on, by an estimate of the first order.
_GEOMETRY_CHANGE, _REFUSED_CHANGE = 0.5, 0.2
# How far away, by the size of the mesh, a solution is another one.
_FAR = 0.1
# Depth, by the length of a facet, of a narrow rod that no point resists: the package allows 5 % and
# 2 % for the rule.
_BETWEEN_POINTS = 0.07
# Parts of an increment in which a rod is followed.
_PARTS = 64
# Forces of the nearest exact solution, and of one found apart.
_NEAREST, _APART = 1e-5, 1e-4
# The latter where multipliers of friction are not determined at the edge of Γc.
_EDGE = 1e-2


def along(surface: Any, u: Array, n: int = 9) -> tuple[Array, Array, Array]:
    """Places all over a surface: displaced by u, undeformed, and the facet of each."""
    grid = np.linspace(0, 1, n if surface.d == 2 else 5)
    at = np.stack([g.ravel() for g in np.meshgrid(*[grid] * (surface.d - 1))], axis=1)
    if surface.simplex:
        at = at[at.sum(axis=1) <= 1 + 1e-12]
    facet = np.repeat(np.arange(len(surface.facets)), len(at))
    xi = np.tile(at, (len(surface.facets), 1))
    return surface.place(facet, xi, u)[0], surface.place(facet, xi)[0], facet


class Judge:
    """Takes the package's increments one by one.

    Attributes:
        wrong: What is wrong, in words.
        another: Where the solution differs from the one found apart, which the laws allow.
        unjudged: Where there is none to compare with.
        worst: Largest figure of every check, in units of what is allowed.
    """

    def __init__(self, scene: dict[str, Any]) -> None:
        """Make the reference's problem twice, once for every history."""
        self.scene = scene
        self.wrong: list[str] = []
        self.another: list[str] = []
        self.unjudged: list[str] = []
        self.worst: dict[str, float] = {}
        # Between curved facets integrals are exact to some times the square of the slope of one
        # against the other only, in both.
        paired = any(c["obstacle"]["kind"] == "body" for c in scene["contacts"])
        slope = 4 * sum(map(abs, scene.get("bend", [0.0])))
        self._curved = _CURVED * slope**2 if paired else 0.0
        scaled = any(
            (c["law"].get(k) or [""])[0] == "scaled" for c in scene["contacts"] for k in _K
        )
        if scaled and scene["cell"] == "hexahedron" and any(b["jitter"] for b in scene["bodies"]):
            self._curved += _SMOOTHED
        self.problem, made, self._load = self._model(scene)
        self._bulge = sum(map(abs, scene.get("bend", []))) * made.length
        self._carried = made.length * float(np.abs(scene.get("carry", [0.0])).max())
        self._between_points: dict[int, float] = {}  # by contact, the most that was pushed there
        self._apart = self._model(scene)[0]
        self.problem.far = self._apart.far = self._carried
        self._moduli = made.moduli
        n, m = self.problem.body.places.size, len(self.problem.motions())
        self._u, self._motion = np.zeros(n), np.zeros(m)
        self._own_u, self._own_motion = np.zeros(n), np.zeros(m)
        self._old = [c.start() for c in self.problem.contacts]
        self._own_old = [c.start() for c in self._apart.contacts]
        self._before: dict[str, Any] | None = None
        self._rods: dict[int, tuple[Array, Array, Array]] = {}  # by contact; see `_check_crossed`
        self._lost = False  # the history apart
        self._tree = None

    @staticmethod
    def _model(scene: dict[str, Any]) -> Any:
        return fuzz_models.model(scene)

    # ---- increments ------------------------------------------------------------------------------

    def take(self, record: dict[str, Any]) -> None:
        """Judge one committed increment."""
        name = f"stage {record['stage']} at {record['load']:.4g}"
        problem, load = self.problem, self._load(record["stage"], record["load"])
        self._change_friction(record["stage"])
        self._take_set_down(name, record, load)
        u = self._numbered(record["u"])
        motion = np.array([record["contacts"][c]["motion"][i] for c, i in problem.motions()])
        old = [
            self._with_multipliers(c, o, r)
            for c, o, r in zip(problem.contacts, self._old, record["contacts"], strict=True)
        ]
        found = problem.respond(u, motion, load, old)
        for c, f, r in zip(problem.contacts, found, record["contacts"], strict=True):
            self._decide(c, f, r)
        now = self._forces(u, load, found)
        rtol = record["rtol"]

        miss = np.abs(u[load.fixed] - load.values).max(initial=0.0)
        allowed = 1e-12 * max(np.abs(u).max(), 1e-300) + _STEPPED * np.abs(self._u).max()
        self._check(name, "conditions", miss, allowed)
        self._check_equations(name, now, rtol)
        for i, (c, f, r) in enumerate(
            zip(problem.contacts, found, record["contacts"], strict=True)
        ):
            self._check_results(f"{name}, contact {i}", c, f, r)
            self._check_multipliers(f"{name}, contact {i}", c, f, r, load.fixed)
        self._check_through(name, u, found, now)
        self._check_geometry(name, u, load, motion, found)
        self._check_kinematics(name, u, motion, load, old, now)
        self._check_energy(name, record, u, motion, load, found, now)
        self._check_nearest(name, record, u, motion, load, old, found, now)
        self._check_apart(name, record, load, now)

        self._old = [
            c.next_state(f, o) for c, f, o in zip(problem.contacts, found, old, strict=True)
        ]
        now |= {"u": u, "motion": motion, "load": load, "found": found}
        # Before points lose their opposites, and with it what their springs had stored.
        now["springs"] = sum(c.stored(f) for c, f in zip(problem.contacts, found, strict=True))
        self._pair_anew(problem, self._old, u)
        self._before, self._u, self._motion = now, u, motion

    def look_ahead(self, stage: int, t: float) -> str:
        """Whether the reference finds a solution at the next load after those taken.

        Returns:
            "not solved apart"; "solved apart"; or "rightly" with what does not hold of the geometry
            there.
        """
        load = self._load(stage, t)
        self._change_friction(stage)
        try:
            u, motion, old = self.problem.solve(self._u, self._motion, load, self._old)
        except (reference.Failed, np.linalg.LinAlgError):
            return "not solved apart"
        before, self.wrong, self.worst = (self.wrong, self.worst), [], {}
        found = self.problem.respond(u, motion, load, old)
        now = self._forces(u, load, found)
        self._check_through("", u, found, now)
        self._check_geometry("", u, load, motion, found)
        self._check_kinematics("", u, motion, load, old, now)
        limits = {"kinematics": _REFUSED_CHANGE / _GEOMETRY_CHANGE}
        off = sorted(n for n, share in self.worst.items() if share > limits.get(n, 1.0))
        self.wrong, self.worst = before
        return f"rightly: {', '.join(off)}" if off else "solved apart"

    def _change_friction(self, stage: int) -> None:
        """Give both histories the friction of a stage."""
        for i, friction in enumerate(fuzz_scenes.frictions(self.scene, stage)):
            if friction is not None:
                for history in (self.problem, self._apart):
                    history.contacts[i].law.friction = friction

    def _check(self, where: str, what: str, value: float, allowed: float, text: str = "") -> bool:
        with np.errstate(all="ignore"):
            share = float(value / allowed) if allowed > 0 else (0.0 if value == 0 else np.inf)
        if not np.isfinite(value):
            share = np.inf
        self.worst[what] = max(self.worst.get(what, 0.0), share)
        if share > 1.0:
            self.wrong.append(f"{what}: {where}: {value:.3g} above {allowed:.3g}{text}")
        return share <= 1.0

    def _numbered(self, rows: Array) -> Array:
        """Values at the nodes of the reference, found by box and place."""
        d, body = self.problem.body.d, self.problem.body
        size = np.ptp(body.places, axis=0).max()
        far = 10 * size
        mine = np.column_stack([body.parts * far, body.places])
        distance, row = scipy.spatial.cKDTree(
            np.column_stack([rows[:, 0] * far, rows[:, 1 : d + 1]])
        ).query(mine)
        assert distance.max() < 1e-9 * size
        return rows[row, d + 1 :].ravel().copy()

    def _take_set_down(self, name: str, record: dict[str, Any], load: Any) -> None:
        """Count slip from set-down or first touch, at points that bore nothing before.

        The package tells where that is. Asked of it is what the reference knows of it: contact just
        touches; bodies that were set down went there as rigid ones, no deeper into anything; and
        where slip is counted anew nothing was borne.
        """
        problem, old = self.problem, list(self._old)
        # Bodies are set down on obstacles where these were before.
        load = self._before["load"] if self._before else self._load(0, 0.0)
        size = np.ptp(problem.body.places, axis=0).max()
        before = self._u
        for i, record_of in enumerate(record["contacts"]):
            told, model = record_of["set_down"], problem.contacts[i]
            if told is None:
                continue
            u = self._numbered(told["u"])
            if told["rigid"]:
                then, now = (problem.respond(v, self._motion, load, old) for v in (before, u))
                deep, deeper = (
                    max(
                        f["closing"][c.paired].max(initial=-np.inf)
                        for c, f in zip(problem.contacts, at, strict=True)
                    )
                    for at in (then, now)
                )
                found = now[i]
                strain, way = self._strain(u - before, before, load), np.abs(u - before).max()
                allowed = _DOWN * way + _ROUND_OFF * size
                self._check(name, "set down rigid", strain, allowed)
                self._check(name, "set down inside", deeper - max(deep, 0.0), _DOWN * size)
                self._check(name, "set down aloft", -deeper, _DOWN * size)
            else:
                found = self._touching(model, record_of, u, old[i])
                miss = abs(found["closing"][model.paired].max())
                self._check(name, "first touch", miss, _DOWN * size)
            idle = told["idle"][self._rows(model, record_of)]
            if self._before is not None:
                borne = np.abs(self._before["found"][i]["r_n"])
                rounding = sum(b["rounding"] for b in self._before["bodies"])
                self._check(name, "set down loaded", model.weights @ (borne * idle), rounding)
            self._old[i] = model.counted_from(found, old[i], idle)
            own, own_old = self._apart.contacts[i], self._own_old[i]
            if told["rigid"]:
                self._own_u = u  # to start from
                apart = self._apart.respond(u, self._own_motion, load, self._own_old)[i]
            else:
                apart = self._touching(own, record_of, u, own_old)
            self._own_old[i] = own.counted_from(apart, own_old, idle)

    def _touching(self, model: Any, record: dict[str, Any], u: Array, old: Any) -> dict[str, Any]:
        """What follows from the state of first touch, in which an obstacle is on its way."""
        if hasattr(model, "respond_at"):
            return model.respond_at(u, old)
        jump = record["set_down"]["jump"][self._rows(model, record)]
        return model.respond(jump, model.at_rest(), old)

    def _strain(self, way: Array, before: Array, load: Any) -> float:
        """What of a motion from a state on is not rigid (length).

        Nodes where displacements are prescribed are left out.
        """
        body, d = self.problem.body, self.problem.body.d
        free = np.ones(way.size, dtype=bool)
        free[load.fixed] = False
        free = free.reshape(-1, d).all(axis=1)
        off = [0.0]
        for b in range(body.parts.max() + 1):
            own = free & (body.parts == b)
            if not own.any():
                continue
            x, w = (body.places + before.reshape(-1, d))[own], way.reshape(-1, d)[own]
            if self.scene.get("bulk", "linear") == "linear":  # small rotations alone are rigid
                x = body.places[own]
                i, j = np.triu_indices(len(x), 1)
                stretch = np.sum((x[i] - x[j]) * (w[i] - w[j]), axis=1) / np.ptp(x, axis=0).max()
            else:
                start, end = (scipy.spatial.distance.pdist(y) for y in (x, x + w))
                stretch = end - start
            off.append(np.abs(stretch).max(initial=0.0))
        return float(max(off))

    def _with_multipliers(self, contact: Any, old: Any, record: dict[str, Any]) -> Any:
        if contact.project is None:
            return old
        row = self._rows(contact, record)
        traction = old.traction
        if contact.law.slips:
            traction = record["lambda_t"][row]
        return reference.State(old.jump, traction, record["lambda_n"][row])

    def _decide(self, contact: Any, found: dict, record: dict[str, Any]) -> None:
        """Let points that only round-off opens or closes be what they were told to be.

        Where a foundation bears no tension τ jumps there: both are solutions.
        """
        if contact.law.kind != "foundation" or contact.law.tension:
            return
        doubtful = contact.k_n * np.abs(found["closing"]) <= self._traction_rounding(contact, found)
        doubtful &= contact.paired
        n = found["normal"]
        across = found["relative"] - np.sum(found["relative"] * n, axis=1)[:, None] * n
        told = np.linalg.norm(record["tangential"][self._rows(contact, record)], axis=1) > 0
        tau = np.where(told[:, None], -contact.k_t[:, None] * across, 0.0)
        found["tau"] = np.where(doubtful[:, None], tau, found["tau"])
        found["traction"] = found["r_n"][:, None] * n + found["tau"]

    def _rows(self, contact: Any, record: dict[str, Any]) -> Array:
        distance, row = scipy.spatial.cKDTree(record["points"]).query(contact.x)
        assert distance.max() < 1e-9 * (np.ptp(contact.x, axis=0).max() or 1.0)
        return row

    def _forces(self, u: Array, load: Any, found: list[dict]) -> dict[str, Any]:
        """Residual and forces, body by body."""
        problem = self.problem
        total, motion = problem.residual(u, load, found)
        parts = np.repeat(problem.body.parts, problem.body.d)
        forces = problem.contact_force(found)
        fixed = np.zeros(len(u), dtype=bool)
        fixed[load.fixed] = True
        moved = np.abs(u)
        if self.scene.get("bulk") == "rubber":
            # It sums up I + ∇u: with the round-off of 1 where it is at rest, too.
            cells = min(min(body["n"]) for body in self.scene["bodies"])
            moved = moved + np.ptp(problem.body.places, axis=0).max() / cells
        rounding = _ROUNDING * (np.abs(problem.stiffness(u)) @ moved)
        for c, f in zip(problem.contacts, found, strict=True):
            each = np.abs(c.interpolation).T @ (c.weights * self._traction_rounding(c, f))
            rounding += np.repeat(each, c.d)
        bodies = []
        for b in range(parts.max() + 1):
            own = parts == b
            sizes = [np.linalg.norm(load.force[own & ~fixed]), np.linalg.norm(total[own & fixed])]
            sizes += [np.linalg.norm(f[own]) for f in forces]
            bodies.append(
                {
                    "residual": float(np.linalg.norm(total[own & ~fixed])),
                    "size": float(max(sizes)),
                    "rounding": float(np.linalg.norm(rounding[own])),
                }
            )
        contacts = []
        for c, f in zip(problem.contacts, found, strict=True):
            w = c.weights * c.paired
            contacts.append(
                {
                    "force": w @ f["traction"],
                    "normal": float(w @ -f["r_n"]),
                    "tangential": float(w @ np.linalg.norm(f["tau"], axis=1)),
                    "size": float(w @ np.linalg.norm(f["traction"], axis=1)),
                }
            )
        return {
            "bodies": bodies,
            "contacts": contacts,
            "determined": self._determined(problem, found, forces, load),
            "total": total,
            "motion rest": motion,
        }

    def _size(self, now: dict[str, Any], kind: str, i: int) -> float:
        """Forces of a body or contact at the ends of the increment, the larger one."""
        sizes = [now[kind][i]["size"]]
        if self._before is not None:
            sizes.append(self._before[kind][i]["size"])
        return max(sizes)

    def _check_equations(self, name: str, now: dict[str, Any], rtol: float) -> None:
        for b, body in enumerate(now["bodies"]):
            size = self._size(now, "bodies", b)
            allowed = (_RESIDUAL * rtol + self._curved) * size + body["rounding"]
            text = f"; forces {size:.3g}"
            self._check(f"{name}, body {b}", "equations", body["residual"], allowed, text)
        if len(now["motion rest"]):
            size = max(self._size(now, "contacts", i) for i in range(len(now["contacts"])))
            rest = float(np.abs(now["motion rest"]).max())
            rounding = max(b["rounding"] for b in now["bodies"])
            self._check(name, "obstacle", rest, _RESIDUAL * rtol * size + rounding)

    def _check_results(self, name: str, contact: Any, found: dict, record: dict[str, Any]) -> None:
        """Reported forces, area and fields against those made anew from u."""
        w = contact.weights
        r_n, tau = found["r_n"], found["tau"]
        size = float(w @ np.linalg.norm(found["traction"], axis=1))
        rounding = self._traction_rounding(contact, found)
        same = _SAME + self._curved
        allowed = same * size + rounding * w.sum()
        self._check(
            name, "reported force", np.abs(record["force"] - w @ found["traction"]).max(), allowed
        )
        self._check(name, "reported N", abs(record["normal_force"] + w @ r_n), allowed)
        tangential = w @ np.linalg.norm(tau, axis=1)
        self._check(name, "reported T", abs(record["tangential_force"] - tangential), allowed)
        bears = contact.law.tension | (r_n < 0)
        doubtful = np.abs(r_n) <= rounding
        low, high = w @ (bears & ~doubtful), w @ (bears | doubtful)
        if contact.law.tension:
            low = 0.0 if not contact.paired.all() else low
        off = max(low - record["area"], record["area"] - high, 0.0)
        self._check(name, "reported area", off, 1e-9 * w.sum())
        # Point by point; those at one place, of the rule of the vertices, together.
        tree = scipy.spatial.cKDTree(contact.x)
        near = 1e-9 * (np.ptp(contact.x, axis=0).max() or 1.0)
        group = np.array([min(tree.query_ball_point(x, near)) for x in contact.x])
        their = group[tree.query(record["points"])[1]]

        def together(where: Array, rows: Array) -> Array:
            total = np.zeros((len(w), rows.shape[1]))
            np.add.at(total, where, rows)
            return total

        own = w[:, None] * np.column_stack([np.ones(len(w)), -r_n, tau])
        told = [np.ones(len(their)), record["pressure"], record["tangential"]]
        apart = together(group, own)
        apart -= together(their, record["measure"][:, None] * np.column_stack(told))
        peak = np.abs(found["traction"]).max(initial=0.0)
        traction = np.abs(apart[:, 1:]).max()
        self._check(name, "reported traction", traction, (same * peak + rounding) * w.max())
        self._check(name, "weights", np.abs(apart[:, 0]).max(), 1e-9 * w.max())

    def _traction_rounding(self, contact: Any, found: dict) -> float:
        """Rounding of u_n - s and of u_t, times the stiffness (stress)."""
        places = np.abs(found["closing"]).max() + np.abs(found["relative"]).max()
        reach = np.abs(contact.x).max() + places + 4 * self._carried + 2 * contact.radius
        stiff = contact.k_n.max() + contact.k_t.max()
        return float(8 * np.finfo(float).eps * stiff * reach)

    @staticmethod
    def _answered(contact: Any, normal: Array, change: Array, fixed: Array) -> Array:
        """What of a change of λ_t displacements of free unknowns can make at the points, (n, d).

        Multipliers of linear elements are as many as displacements; where some of these are held
        nothing answers the others, and nothing is asked of them.
        """
        across = np.eye(contact.d) - normal[:, :, None] * normal[:, None, :]
        made = np.einsum("qj,qkl->qkjl", contact.interpolation, across)
        made = made.reshape(change.size, -1)
        free = np.ones(made.shape[1], dtype=bool)
        free[fixed] = False
        made = made[:, free & made.any(axis=0)]
        weight = np.sqrt(np.repeat(contact.weights, contact.d))
        state = np.linalg.lstsq(weight[:, None] * made, weight * change.ravel(), rcond=1e-12)[0]
        return np.asarray(made @ state).reshape(change.shape)

    def _check_multipliers(
        self, name: str, contact: Any, found: dict, record: dict, fixed: Array
    ) -> None:
        """What the springs still bear, after projection, relative to the tractions."""
        if contact.project is None:
            return
        row = self._rows(contact, record)
        scale = max(np.abs(found["r_n"]).max(), np.abs(found["tau"]).max(initial=0.0))
        for old in (self._before or {}).get("found", []):
            scale = max(scale, np.abs(old["r_n"]).max(), np.abs(old["tau"]).max(initial=0.0))
        left = 0.0
        if contact.law.has_normal:
            left = np.abs(contact.project @ -found["r_n"] - record["lambda_n"][row]).max()
        if contact.law.slips:
            tau = found.get("framed", found["tau"])  # in the frame of an obstacle that turns
            change = contact.project @ tau - record["lambda_t"][row]
            if self.scene["degree"] == 1:
                change = self._answered(contact, found["normal"], change, fixed)
            left = max(left, np.abs(change).max())
        allowed = 2 * record["tolerance"] * scale + 4 * self._traction_rounding(contact, found)
        self._check(name, "multipliers", left, allowed)
        # However large the tractions are: what is inside is not by as much as anyone can see.
        if contact.law.has_normal:
            # Of a facet that reaches past the obstacle the points beside it lead the plane astray.
            deep = np.minimum(contact.project @ found["closing"], found["closing"])
            deep = np.where(found["r_n"] < 0, deep, 0.0).max()
            # Γc may be one point.
            size = np.ptp(contact.x, axis=0).max() or np.ptp(self.problem.body.places, axis=0).max()
            # Multipliers are linear over a facet; of a coarse one what it bulges stays inside.
            bulges = self._bulges(self.scene["contacts"][self.problem.contacts.index(contact)])
            self._check(name, "inside", deep, _INSIDE * size + bulges)

    def _bulges(self, given: dict[str, Any]) -> float:
        """By how much facets of a contact are not flat, or what they touch is not (length)."""
        return float(self._bulge / self.scene["bodies"][given["body"]]["n"][0] ** 2)

    def _check_through(self, name: str, u: Array, found: list[dict], now: dict[str, Any]) -> None:
        """Whether the other body sees far more contact than Γc does: it has passed through."""
        for i, contact in enumerate(self.problem.contacts):
            if contact.back is None or not contact.law.has_normal:
                continue
            pushed = float(contact.k_n.mean() * contact.back(u))
            # Coarse bodies overlap between the points by elastic deformation: that has its force,
            # in this contact or in one that looks the other way.
            same = [j for j in range(len(found)) if self._between(j) == self._between(i)]
            allowed = 1e4 * max(now["contacts"][j]["normal"] for j in same)
            # So do surfaces that are not flat, unloaded, by a little of what they differ, which
            # few points do not tell, and what a facet bulges between its corners is not seen from
            # these.
            differ = 0.1 * max(self._bulge, *(float(np.ptp(found[j]["closing"])) for j in same))
            differ += 0.02 * float(contact.here.lengths().max())
            if self.scene["contacts"][i].get("scheme") == "vertex":
                differ += self._bulge
            allowed += float(contact.k_n.mean() * contact.weights.sum()) * differ
            allowed += 1e3 * sum(b["rounding"] for b in now["bodies"])
            # Fewer points than a facet has nodes do not hold all of it, by the user's choice or
            # where it overhangs: what came between under a load may stay when that is taken off.
            few = self.scene["contacts"][i].get("quadrature", np.inf) < 2 * self.scene["degree"]
            if few or not contact.paired.all():
                allowed += self._between_points.get(i, 0.0)
                self._between_points[i] = max(pushed, self._between_points.get(i, 0.0))
            self._check(f"{name}, contact {i}", "passed through", pushed, allowed)

    def _check_geometry(
        self, name: str, u: Array, load: Any, motion: Array, found: list[dict]
    ) -> None:
        """Depth of Γc in rigid obstacles where it has moved to, beyond what points resist."""
        shifts = self.problem.shifts(load, motion)
        for i, (c, f, shift) in enumerate(zip(self.problem.contacts, found, shifts, strict=True)):
            if c.near is None or not c.law.has_normal or c.law.tension:
                continue
            x, _, facet = along(c.here, u)
            deep = -c.near(x, shift)[0]
            corners = c.here.corner_vertices
            borne = np.zeros(corners.max() + 1)
            np.maximum.at(borne, corners[c.facet], np.maximum(f["closing"], 0.0)[:, None])
            resisted = borne[corners].max(axis=1)[facet]
            bulge = self._bulges(self.scene["contacts"][i])
            share = (deep - resisted - bulge) / c.here.lengths()[facet]
            self._check(f"{name}, contact {i}", "penetration", share.max(), UNRESISTED)
            if c.spine is not None and c.d == 2:
                self._check_crossed(f"{name}, contact {i}", i, u, c.spine_at(shift))

    def _check_crossed(self, name: str, i: int, u: Array, spine: Array) -> None:
        """Whether the middle line of a rod has come through Γc, over all increments.

        Its places are followed on straight paths. What comes in by a side that is not Γc, which
        nobody looks at, does not count. Γc must be a graph over x.
        """
        contact = self.problem.contacts[i]
        if i not in self._rods:
            began = contact.spine_at(contact.at_rest())
            self._rods[i] = (0.0 * u, began, np.zeros(len(began), dtype=int))
        before, start, state = self._rods[i]
        first, at, _ = along(contact.here, before)
        last = along(contact.here, u)[0]
        order = np.argsort(at[:, 0])
        height = np.zeros(len(spine))
        for share in np.linspace(0, 1, _PARTS + 1):
            x = (first + share * (last - first))[order]
            q = start + share * (spine - start)
            height = q[:, 1] - np.interp(q[:, 0], x[:, 0], x[:, 1])
            over = (q[:, 0] > x[:, 0].min()) & (q[:, 0] < x[:, 0].max())
            # Not over Γc 0, below it -1, through it 1, in the body by another way 2.
            inside = np.where(state == -1, 1, np.where(state == 0, 2, state))
            state = np.where(over, np.where(height > 0, inside, -1), 0)
        self._rods[i] = (u, spine, state)
        through = np.where(state == 1, height, 0.0).max()
        facet = float(contact.here.lengths().max())
        wide = np.ptp(spine[:, 0]) > 2 * facet
        self._check(name, "crossed", through, (0.02 if wide else _BETWEEN_POINTS) * facet)

    def _check_kinematics(
        self, name: str, u: Array, motion: Array, load: Any, old: list[Any], now: dict[str, Any]
    ) -> None:
        """Whether contact forces stay where geometry is taken at the places that u leads to."""
        problem = self.problem
        kept = [(c.place, c.interpolation, c.paired) for c in problem.contacts]
        shifts = problem.shifts(load, motion)
        changed = False
        try:
            for c, shift in zip(problem.contacts, shifts, strict=True):
                jump, paired = c.jump(u), c.paired
                gap, normal = c.placed(shift)
                if c.near is not None:
                    x = c.x + jump
                    changed |= self._differ(c, jump, shift, *c.near(x, shift), gap, normal)

                    def place(s: Array, c: Any = c, x: Array = x, jump: Array = jump) -> Any:
                        gap, normal = c.near(x, s)
                        return gap + np.sum(jump * normal, axis=1), normal

                    c.place = place
                elif c.anew is not None and c.repair is None:
                    c.interpolation, gap, c.paired = c.anew(u)
                    both = paired & c.paired
                    off = np.abs((c.jump(u) - jump)[both]).max(initial=0.0)
                    near = off <= 1e-9 * np.ptp(c.here.body.places, axis=0).max()
                    changed |= not near or bool((paired != c.paired).any())
                    c.place = lambda s, gap=gap, normal=normal: (gap, normal + 0 * s)
            if not changed:
                return
            near, moved = problem.increment_of(u, motion, load, old, 1e-9)
            if np.abs(near - u).max() > _FAR * np.ptp(problem.body.places, axis=0).max():
                raise reference.Failed("what follows from the geometry is far away")
            forces = self._forces(near, load, problem.respond(near, moved, load, old))["contacts"]
        except (reference.Failed, np.linalg.LinAlgError) as failure:
            self.unjudged.append(f"{name}: kinematics: {failure}")
            return
        finally:
            for c, (place, interpolation, paired) in zip(problem.contacts, kept, strict=True):
                c.place, c.interpolation, c.paired = place, interpolation, paired
        for i in range(len(forces)):
            # Of both sides of one contact which bears what is not determined.
            same = [j for j in range(len(forces)) if self._between(j) == self._between(i)]
            size = max(max(self._size(now, "contacts", j), forces[j]["size"]) for j in same)
            off = abs(sum(forces[j]["normal"] - now["contacts"][j]["normal"] for j in same))
            allowed = _GEOMETRY_CHANGE * size + 30 * max(b["rounding"] for b in now["bodies"])
            self._check(f"{name}, contact {i}", "kinematics", off, allowed)

    @staticmethod
    def _differ(
        c: Any, jump: Array, shift: Array, far: Array, normal: Array, gap: Array, old: Array
    ) -> bool:
        """Whether distance and normal at the deformed places are others than those taken."""
        off = np.abs(far - gap + np.sum(jump * old, axis=1)).max()
        size = np.ptp(c.here.body.places, axis=0).max()
        return bool(off > 1e-9 * size or np.abs(normal - old).max() > 1e-6)

    def _between(self, i: int) -> set[tuple[Any, Any]]:
        """The two surfaces of a contact, as body and side."""
        given = self.scene["contacts"][i]
        obstacle = given["obstacle"]
        return {(given["body"], given["side"]), (obstacle.get("body"), obstacle.get("side"))}

    def _check_energy(
        self,
        name: str,
        record: dict[str, Any],
        u: Array,
        motion: Array,
        load: Any,
        found: list[dict],
        now: dict[str, Any],
    ) -> None:
        """Works and energies of the increment against those made anew."""
        problem, before = self.problem, self._before
        stiff = problem.body.stiffness
        way = u - self._u
        outside = load.force.copy()
        outside[load.fixed] += now["total"][load.fixed]
        inside = stiff @ u
        work = 0.5 * outside @ way
        elastic = 0.5 * inside @ way
        springs = sum(c.stored(f) for c, f in zip(problem.contacts, found, strict=True))
        slid = sum(c.dissipated(f) for c, f in zip(problem.contacts, found, strict=True))
        pushes = np.array([load.pushes[c][i] for c, i in problem.motions()])
        work += 0.5 * pushes @ (motion - self._motion)
        forces = [c["force"] for c in now["contacts"]]
        ways = load.shifts
        if before is not None:
            work += 0.5 * before["outside"] @ way + 0.5 * before["pushes"] @ (motion - self._motion)
            elastic += 0.5 * before["inside"] @ way
            springs -= before["springs"]
            ends = zip(forces, before["contacts"], strict=True)
            forces = [f + b["force"] for f, b in ends]
            ways = [s - b for s, b in zip(load.shifts, before["shifts"], strict=True)]
        work += sum(0.5 * f @ s for f, s in zip(forces, ways, strict=True))
        now |= {"outside": outside, "inside": inside, "shifts": load.shifts, "pushes": pushes}
        energy = record["energy"]
        if energy is None:
            return
        penalty = all(c.project is None for c in problem.contacts)
        scale = np.abs(outside) @ np.abs(way) + abs(springs) + abs(slid)
        scale += sum(np.abs(f) @ np.abs(s) for f, s in zip(forces, ways, strict=True))
        if before is not None:
            scale += np.abs(before["outside"]) @ np.abs(way)
        allowed = max(1e-6, 300 * record["rtol"], self._curved) * scale
        rounding = sum(b["rounding"] for b in now["bodies"])
        if before is not None:  # of a state that may have been carried far without any strain
            rounding = max(rounding, sum(b["rounding"] for b in before["bodies"]))
        allowed += 10 * rounding * max(np.abs(u).max(), np.abs(self._u).max(initial=0.0))
        for c, f in zip(problem.contacts, found, strict=True):
            stiff = c.k_n[c.k_n > 0].min(initial=np.inf)
            allowed += 10 * c.weights.sum() * self._traction_rounding(c, f) ** 2 / stiff
        pairs = [("work", energy.work, work), ("elastic", energy.elastic, elastic)]
        if penalty:
            pairs += [
                ("springs", energy.springs, springs),
                ("dissipation", energy.dissipation, slid),
            ]
        for what, given, own in pairs:
            self._check(name, f"energy {what}", abs(given - own), allowed)
        if penalty and slid < -allowed:
            self.wrong.append(f"energy: {name}: dissipation {slid:.3g} is negative")

    def _tolerance(self, record: dict[str, Any], base: float) -> float:
        """Of forces, by what was asked for."""
        found = max(base, 300 * record["rtol"], self._curved)
        for contact in record["contacts"]:
            if contact["lambda_n"] is not None:
                found = max(found, 30 * contact["tolerance"])
            if contact["error"]:
                found = max(found, contact["error"])
        return found

    def _unanswered(self, load: Any) -> bool:
        """Whether some multipliers of friction are answered by no displacement; see `_answered`.

        What they come to depends on the rounds, and the springs next to them make up for it.
        """
        held = self.scene["degree"] == 1 and load.fixed.size
        return bool(held) and any(
            c.project is not None and c.law.slips for c in self.problem.contacts
        )

    def _unique(self) -> bool:
        return all(c.law.unique and not c.free for c in self.problem.contacts)

    def _check_nearest(
        self,
        name: str,
        record: dict[str, Any],
        u: Array,
        motion: Array,
        load: Any,
        old: list[Any],
        found: list[dict],
        now: dict[str, Any],
    ) -> None:
        """Distance, in forces, from the exact solution of the same equations next to it."""
        try:
            near, moved = self.problem.increment_of(u, motion, load, old, 1e-12)
        except reference.Failed as failure:
            self.unjudged.append(f"{name}: nearest: {failure}")
            return
        exact = self._forces(near, load, self.problem.respond(near, moved, load, old))
        for i, contact in enumerate(exact["contacts"]):
            size = self._size(now, "contacts", i)
            rounding = max(b["rounding"] for b in now["bodies"])
            error = np.abs(contact["force"] - now["contacts"][i]["force"]).max()
            allowed = self._tolerance(record, _NEAREST) * size + 10 * rounding
            if error > allowed and not self._unique():
                self.another.append(f"{name}, contact {i}: nearest differs by {error / size:.1e}")
            else:
                self._check(f"{name}, contact {i}", "nearest", error, allowed)

    def _check_apart(
        self, name: str, record: dict[str, Any], load: Any, now: dict[str, Any]
    ) -> None:
        """Compare with the history solved apart."""
        if self._lost:
            return
        problem = self._apart
        try:
            u, motion, old = problem.solve(self._own_u, self._own_motion, load, self._own_old)
        except (reference.Failed, np.linalg.LinAlgError) as failure:
            self.unjudged.append(f"{name}: apart: {failure}")
            self._lost = True
            return
        found = problem.respond(u, motion, load, old)
        tolerance = self._tolerance(record, _APART)
        worst = 0.0
        rounding = max(b["rounding"] for b in now["bodies"])
        forces = self._determined(problem, found, problem.contact_force(found), load)
        for i in range(len(forces)):
            force, here = self._shared(forces, i), self._shared(now["determined"], i)
            size = max(self._size(now, "contacts", i), float(np.abs(force).max()))
            error = np.abs(force - here).max()
            allowed = tolerance * size + 30 * rounding
            if allowed > 0:
                worst = max(worst, error / allowed)
            text = f"{name}, contact {i}: {here} here, {force} apart"
            if error > allowed:
                told = self._unique() and not (self._unanswered(load) and error <= _EDGE * size)
                (self.wrong if told else self.another).append("apart: " + text)
        self.worst["apart"] = max(self.worst.get("apart", 0.0), worst)
        if worst > 1.0:
            self._lost = True
        self._own_old = [
            c.next_state(f, o) for c, f, o in zip(problem.contacts, found, old, strict=True)
        ]
        self._pair_anew(problem, self._own_old, u)
        self._own_u, self._own_motion = u, motion

    def _shared(self, forces: list[Array], i: int) -> Array:
        """Force on the body of a contact by all contacts between the same two surfaces.

        How much of it which one bears is not determined where multipliers are on both sides.
        """
        total, body = np.zeros_like(forces[i]), self.scene["contacts"][i]["body"]
        for j, contact in enumerate(self.problem.contacts):
            if j == i or (contact.project is not None and self._between(j) == self._between(i)):
                sign = 1.0 if self.scene["contacts"][j]["body"] == body else -1.0
                total += sign * forces[j]
        return total

    def _determined(
        self, problem: Any, found: list[dict], forces: list[Array], load: Any
    ) -> list[Array]:
        """Force of every contact; with multipliers of friction that on the free unknowns alone.

        Where a displacement is prescribed and the point sticks, neither slip nor balance tells how
        much of the reaction is contact: any multiplier within the limit is a solution, and where
        the normal is aslant so are pressures with it.
        """
        told = []
        given = zip(problem.contacts, found, forces, self.scene["contacts"], strict=True)
        for c, f, force, scene in given:
            if c.project is None or not c.law.slips:
                told.append((c.weights * c.paired) @ f["traction"])
                continue
            free = force.copy()
            free[load.fixed] = 0.0
            own = problem.body.parts == scene["body"]
            told.append(free.reshape(-1, c.d)[own].sum(axis=0))
        return told

    @staticmethod
    def _pair_anew(problem: Any, states: list[Any], u: Array) -> None:
        """New pairs where they follow the bodies; slip counts from between the new ones."""
        for contact, state in zip(problem.contacts, states, strict=True):
            if contact.repair is None:
                continue
            before = contact.jump(u)
            contact.repair(u)
            state.jump += contact.jump(u) - before
