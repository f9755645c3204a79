"""Tests of random scenes against an independent solver, of that solver and of the comparison.

Tolerances of the comparison are those of ``verification/fuzz_comparison.py``.
"""

import copy
import csv
import json
import subprocess
import sys

import numpy as np
import pytest
from mpi4py import MPI

from fenics_contact.checks.tunnelling import TunnellingCheck
from scenes.processes import ROOT, subprocess_environment
from verification import (
    campaigns,
    finite_reference,
    finite_scenes,
    fuzz,
    fuzz_features,
    fuzz_reference,
    fuzz_scenes,
    reference_geometry,
    reference_laws,
    sliding_scenes,
)
from verification import reference_solver as reference

COMM = MPI.COMM_WORLD
serial = pytest.mark.skipif(COMM.size > 1, reason="nothing here depends on ranks")
SCENES = json.loads((ROOT / "verification" / "fuzz_regressions.json").read_text())
# Scenes that were wrong; open ones are expected to fail, some on one rank only.
REGRESSIONS = [
    pytest.param(
        entry,
        id=entry["name"],
        marks=[pytest.mark.xfail(strict=True)]
        * (entry["open"] and (COMM.size == 1 or "ranks" not in entry)),
    )
    for entry in SCENES["regressions"]
]
FINE = ("right", "another", "refused")


def solve(scene, **options):
    """Return the outcome of a scene on all ranks."""
    outcome = fuzz.run_scene(copy.deepcopy(scene), COMM if COMM.size > 1 else None, **options)
    return COMM.bcast(outcome)


# ---- scenes --------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize(
    "part",
    [part if part < 5 else pytest.param(part, marks=pytest.mark.slow) for part in range(10)],
)
def test_scenes_are_not_wrong(part):
    # All scenes on one rank, every fifth on several.
    for scene in SCENES["scenes"][part::10][:: 1 if COMM.size == 1 else 5]:
        outcome = solve(scene)
        assert outcome.outcome in FINE, f"{outcome}\n{json.dumps(scene)}"


FINITE = [*SCENES["finite"], *SCENES["bodies"]]


@pytest.mark.mpi
@pytest.mark.parametrize("number", range(len(FINITE)))
def test_scenes_of_finite_kinematics_are_right(number):
    """Scenes have moving and rotating obstacles, linear and rubber bodies, or two bodies."""
    if COMM.size > 1 and number % 4:
        pytest.skip("takes longer on several ranks")
    scene = FINITE[number]
    outcome = solve(scene)
    assert outcome.outcome in FINE, f"{outcome}\n{json.dumps(scene)}"
    if COMM.size == 1:
        assert outcome.outcome == "right"
        assert outcome.increments and {"equations", "independent", "nearest"} <= set(
            outcome.error_ratios
        )


@pytest.mark.mpi
@pytest.mark.parametrize("seed", [720024, 720031, 720034, 720046])
def test_body_between_two_others_is_positioned(seed):
    """A block between a moved block and a cavity is unconstrained until it touches both.

    Without load any position between them is an equilibrium.
    """
    without = ("multipliers", "motion", "accuracy", "method", "max_iterations", "restart", "units")
    scene = fuzz_scenes.draw(seed, without=(*without, "increment"), family=seed // 24)
    outcome = solve(scene)
    assert outcome.outcome in ("right", "another"), outcome


@serial
def test_methods_are_tried_in_turn_on_a_refused_scene(monkeypatch):
    """The methods are tried one after another, until one has a correct solution."""
    methods = []

    def run_scene(scene, comm=None, **_):
        assert scene["max_iterations"]
        methods.append(scene["method"])
        outcome = {"newton": "refused", "continuation": "wrong"}.get(scene["method"], "another")
        return fuzz.Outcome(outcome, "", 1, 0.0, [], {})

    monkeypatch.setattr(fuzz, "run_scene", run_scene)
    assert fuzz.find_solving_method({"seed": 1}) == "primal_dual"
    assert methods == ["newton", "continuation", "primal_dual"]


@serial
def test_stalled_iteration_is_refused():
    """Newton's method stalls at a residual of nearly 1e-2 of the forces; other methods fail too."""
    name = "a factorisation that failed, followed by another"
    scene = next(e["scene"] for e in SCENES["regressions"] if e["name"] == name)
    outcome = solve(scene | {"method": "newton"})
    assert outcome.outcome == "refused"
    assert "Tried: newton: no progress (" in outcome.detail[0]
    outcome = solve(scene)
    assert outcome.outcome == "refused"
    assert "converged (" not in outcome.detail[0]


@serial
@pytest.mark.parametrize("method", [None, "newton", "lbfgs", "continuation"])
def test_every_method_solves_obstacle_constrained_by_pressure(method):
    """The scene must not be refused as an overload before the methods that solve it are tried."""
    name = "an obstacle constrained by a prescribed pressure alone"
    scene = next(e["scene"] for e in SCENES["regressions"] if e["name"] == name)
    assert solve(scene | ({"method": method} if method else {})).outcome == "right"


@serial
def test_most_scenes_are_solved_and_compared():
    # If all scenes were refused, or none compared, test_scenes_are_not_wrong would pass.
    computed = [(scene["seed"], solve(scene)) for scene in SCENES["scenes"][::7]]
    solved = [(seed, o) for seed, o in computed if o.outcome in ("right", "another")]
    assert len(solved) > 0.7 * len(computed)
    for seed, outcome in solved:
        # The first increment of two scenes is not solved independently.
        required = {"equations", "nearest"} | (
            {"independent"} if seed not in (600094, 600209) else set()
        )
        assert outcome.increments and required <= set(outcome.error_ratios), seed


@pytest.mark.mpi
@pytest.mark.parametrize("entry", REGRESSIONS)
def test_formerly_wrong_scenes_are_not_wrong(entry):
    outcome = solve(entry["scene"])
    assert outcome.outcome in entry.get("allowed", FINE), outcome


@pytest.mark.mpi
@pytest.mark.parametrize("form", fuzz_scenes.FORMS[1:])
def test_equivalent_bulk_forms_are_right(form):
    """Every form of two materials, linear or rubber, agrees with piecewise constant E."""
    if COMM.size > 1 and form not in ("pairs", "beside"):
        pytest.skip("takes longer on several ranks")
    linear = next(s for s in SCENES["scenes"] if s["seed"] == 600052) | {"weight": 0.1}
    rubber = next(s for s in SCENES["bodies"] if s["seed"] == 2419)
    for scene in (linear, rubber):
        outcome = solve(scene | {"form": form})
        assert outcome.outcome == "right", f"{outcome}\n{json.dumps(scene)}"


# ---- errors are detected -------------------------------------------------------------------------

ONE = {
    "layout": "floor",
    "cell": "quadrilateral",
    "degree": 1,
    "nu": 0.3,
    "bodies": [{"origin": [0.0, 0.0], "size": [1.0, 1.0], "n": [3, 2], "E": 1000.0, "jitter": 5}],
    "units": [1.0, 1.0],
    "drive": "prescribed",
    "contacts": [
        {
            "body": 0,
            "side": "bottom",
            "obstacle": {"kind": "halfspace", "clearance": 0.0},
            "law": {
                "kind": "coulomb",
                "friction": 0.3,
                "k_n": ["number", 10.0],
                "k_t": ["number", 10.0],
            },
        }
    ],
    "dirichlet": [[0, "top", [0, 1], "moved"]],
    "strain": 1e-3,
    "load_ratio": 1.0,
    "stages": [
        {"steps": 1, "normal": 1.0, "side": 0.0, "across": 0.0},
        {"steps": 2, "normal": 1.0, "side": 0.4, "across": 0.0},
    ],
}


@serial
def test_correct_scene_is_right():
    assert solve(ONE).outcome == "right"


def _move_a_node(record):
    record["u"][4, -1] += 1e-6 * np.abs(record["u"][:, -1]).max()


def _more_force(record):
    record["contacts"][0]["normal_force"] *= 1 + 1e-6


def _less_pressure(record):
    record["contacts"][0]["pressure"][1] *= 1 - 1e-6


def _more_work(record):
    vars(record["energy"])["work"] *= 1.001


@pytest.mark.whole
@serial
@pytest.mark.parametrize(
    ("perturb", "check"),
    [
        (_move_a_node, "equations"),
        (_more_force, "reported N"),
        (_less_pressure, "reported traction"),
        (_more_work, "energy work"),
    ],
)
def test_wrong_result_is_detected(perturb, check):
    outcome = solve(ONE, perturb=perturb)
    assert outcome.outcome == "wrong"
    assert check in outcome.kind


def change_history(change):
    """Return a modification that changes the history after every commit."""

    def modify(setup, problem):
        commit, history = problem.commit, problem.contacts[0].history

        def perturb():
            commit()
            values = {n: history.values(n) for n in history.names}
            history.assign(values | change(history))

        problem.commit = perturb

    return modify


def _reduce_traction(history):
    return {"traction": 0.999 * history.values("traction")}


@serial
def test_wrong_history_is_detected():
    outcome = solve(ONE, modify=change_history(_reduce_traction))
    assert outcome.outcome == "wrong"
    assert "equations" in outcome.kind


@serial
def test_wrong_friction_coefficient_is_detected():
    def modify(setup, problem):
        setup.scene = copy.deepcopy(setup.scene)
        setup.scene["contacts"][0]["law"]["friction"] = 0.3003

    # At the end half of the points slip.
    outcome = solve(ONE, modify=modify)
    assert outcome.outcome == "wrong"


# A block pressed on a disc that is slid and rotated, so little that some points stick.
TURNING = copy.deepcopy(ONE) | {
    "kinematics": "finite",
    "bulk": "linear",
    "drive": "obstacle",
    "dirichlet": [[0, "top", [0, 1], "fixed"]],
    "strain": 0.05,
    "stages": [
        {"steps": 1, "normal": 1.0, "side": 0.0, "across": 0.0, "turn": 0.0},
        {"steps": 2, "normal": 1.0, "side": 0.01, "across": 0.0, "turn": 0.02},
    ],
}
TURNING["contacts"][0]["obstacle"] = {
    "kind": "ball",
    "clearance": 0.0,
    "radius": 1.0,
    "moving": "displacement",
    "turn": "middle",
}


# A block pressed on a slab, slid, and rotated together with it; half of the points slip.
TWO = copy.deepcopy(TURNING) | {
    "kinematics": "finite sliding",
    "bulk": "rubber",
    "layout": "two",
    "drive": "prescribed",
    "bodies": [
        {"origin": [0.0, 0.0], "size": [2.0, 0.8], "n": [4, 2], "E": 100.0, "jitter": 3},
        {"origin": [0.7, 0.8], "size": [0.6, 0.6], "n": [3, 2], "E": 100.0, "jitter": 0},
    ],
    "dirichlet": [[0, "bottom", [0, 1], "fixed"], [1, "top", [0, 1], "moved"]],
    "strain": 0.1,
    "stages": [
        {"steps": 2, "normal": 1.0, "side": 0.0, "across": 0.0, "turn": 0.0, "spin": 0.0},
        {"steps": 2, "normal": 1.0, "side": 0.05, "across": 0.0, "turn": 0.02, "spin": 0.7},
    ],
}
TWO["contacts"][0] |= {
    "body": 1,
    "obstacle": {"kind": "body", "update_pairs": "never", "body": 0, "side": "top"},
}
FAR = pytest.mark.parametrize("scene", [TURNING, TWO], ids=["obstacle", "bodies"])


@serial
@FAR
def test_correct_scene_with_finite_kinematics_is_right(scene):
    assert solve(scene).outcome == "right"


def _exchange_components(history):
    return {"traction": history.values("traction")[:, ::-1]}


def _shift_slip_reference(history):
    return {"jump": history.values("jump") + 1e-6}


@serial
@FAR
@pytest.mark.parametrize("change", [_exchange_components, _shift_slip_reference])
def test_wrong_history_with_finite_kinematics_is_detected(change, scene):
    """Exchanged traction components, or a slip reference shifted by 1e-6, are detected."""
    outcome = solve(scene, modify=change_history(change))
    assert outcome.outcome == "wrong"
    assert "equations" in outcome.kind


# A block guided by a wall, with few points per facet, in a cavity: it is positioned.
LOOSE = copy.deepcopy(TURNING) | {
    "bulk": "rubber",
    "drive": "force",
    "dirichlet": [[0, "left", [0], "fixed"]],
    "stages": [
        {"steps": 2, "normal": 1.0, "side": 0.01, "across": 0.0, "turn": 0.0},
        {"steps": 1, "normal": 0.0, "side": 0.0, "across": 0.0, "turn": 0.0},
        {"steps": 1, "normal": 1.0, "side": 0.01, "across": 0.0, "turn": 0.0},
    ],
}
LOOSE["contacts"][0]["obstacle"]["kind"] = "cylinder inside"
LOOSE["contacts"][0]["quadrature"] = 5


@serial
def test_correct_positioning_is_right():
    outcome = solve(LOOSE)
    assert outcome.outcome == "right"
    assert {"positioning rigid", "positioning depth", "positioning gap", "independent"} <= set(
        outcome.error_ratios
    )


def _deeper(u):
    u[:, -1] -= 1e-4


def _higher(u):
    u[:, -1] += 1e-4


def _wider(u):
    u[:, -1] += 1e-4 * u[:, 2]


@serial
@pytest.mark.parametrize(
    ("change", "check"), [(_deeper, "depth"), (_higher, "gap"), (_wider, "rigid")]
)
def test_wrong_positioning_is_detected(change, check):
    def perturb(record):
        if record["contacts"][0]["slip_reset"] is not None:
            change(record["contacts"][0]["slip_reset"]["u"])

    outcome = solve(LOOSE, perturb=perturb)
    assert outcome.outcome == "wrong"
    assert f"positioning {check}" in outcome.kind


@serial
def test_traction_that_is_not_rotated_is_detected():
    """The committed traction remains fixed in space while both bodies rotate."""

    def modify(setup, problem):
        present = problem.contacts[0].pairs
        present.rotate = lambda vectors, inverse=False: vectors

    outcome = solve(TWO, modify=modify)
    assert outcome.outcome == "wrong"
    assert "equations" in outcome.kind


@serial
@pytest.mark.parametrize("quantity", ["angle", "shift"])
def test_wrong_obstacle_position_is_detected(quantity):
    """An obstacle that rotates or moves by 0.1 % more than prescribed is detected."""

    def modify(setup, problem):
        apply, value = setup.apply, getattr(setup, quantity)

        def more(stage, t):
            apply(stage, t)
            value.value = 1.001 * value.value

        setup.apply = more

    assert solve(TURNING, modify=modify).outcome == "wrong"


@pytest.mark.whole
@serial
@pytest.mark.parametrize("kind", finite_scenes.KINDS)
def test_gap_gradients_of_the_independent_solver(kind):
    """Gap gradients are minus the unit normal (finite differences near the lowest vertex, 1e-6)."""
    for d in (2, 3):
        if d == 2 and kind in ("torus", "turned profile"):
            continue
        obstacle = {"kind": kind, "clearance": 0.01, "radius": 1.3, "points": 24, "flat": 0.8}
        body = {"origin": [0.0] * d, "size": [1.0, 1.1, 0.9][:d], "n": [1] * d}
        scene = {"bodies": [body], "units": [1.0, 1.0]}
        contact = {"side": "bottom", "obstacle": obstacle}
        shape = finite_reference.make_shape(scene, contact)
        x = np.random.default_rng(2).uniform(-0.05, 0.05, (40, d)) + 0.4 * (np.arange(d) < d - 1)
        distance, normal = shape(x)
        assert np.abs(distance).max() < 1.0
        assert np.allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
        slope = np.zeros_like(x)
        for i in range(d):
            step = 1e-6 * np.eye(d)[i]
            slope[:, i] = (shape(x + step)[0] - shape(x - step)[0]) / 2e-6
        off = np.linalg.norm(slope + normal, axis=1)
        # The difference may involve two facets.
        assert np.sum(off > 1e-6) <= (2 if kind == "facets" else 0)


@serial
def test_crashes_and_refusals_are_distinguished():
    def raises(setup, problem):
        raise KeyError("k_n")

    assert solve(ONE, modify=raises).outcome == "crashed"
    bad = copy.deepcopy(ONE)
    bad["dirichlet"], bad["drive"] = [], "force"
    bad["stages"][0]["normal"] = -1.0
    outcome = solve(bad)
    assert outcome.outcome == "refused"
    assert outcome.kind.startswith("ValueError: ")


# ---- additional features -------------------------------------------------------------------------

# A block with fixed top, and a thin plate below it that moves up.
PLATE = copy.deepcopy(ONE) | {
    "drive": "obstacle",
    "dirichlet": [[0, "top", [0, 1], "fixed"]],
    "stages": [{"steps": 1, "normal": 2.0, "side": 0.0, "across": 0.0}],
    "cuts": 0,
}
PLATE["contacts"][0]["obstacle"] = {
    **{"kind": "rod", "shape": "plate", "radius": 0.01, "half": 0.4, "tilt": 0.0},
    **{"at": 0.5, "clearance": 0.001, "moving": "displacement"},
}


def _tunnelling_scene():
    """Return a scene whose plate moves by 0.3 through the bottom of the block."""
    scene = copy.deepcopy(PLATE)
    scene["stages"][0]["normal"] = 300.0
    return scene


@serial
@pytest.mark.parametrize("unrelated", fuzz_features.UNRELATED_BODIES)
def test_scene_with_an_unrelated_body_is_right(unrelated):
    assert solve(ONE | {"unrelated_body": unrelated}).outcome == "right"


@serial
@pytest.mark.parametrize("scene", [ONE, TURNING, TWO], ids=["small", "obstacle", "bodies"])
def test_translated_scene_is_right(scene):
    carried = copy.deepcopy(scene) | {"translation": [20.0, 5.0]}
    if scene is not TWO:
        carried["contacts"][0]["obstacle"].setdefault("moving", "translated")
    assert solve(carried).outcome == "right"


@serial
def test_plate_that_passes_through_a_facet_is_refused():
    assert solve(PLATE).outcome == "right"
    assert solve(_tunnelling_scene()).outcome == "refused"


@serial
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_comparison_detects_tunnelling_of_a_plate(kinematics, monkeypatch):
    monkeypatch.setattr(TunnellingCheck, "evaluate", lambda self, before: {})
    scene = _tunnelling_scene()
    if kinematics == "finite":
        scene |= {"kinematics": "finite", "bulk": "linear"}
        scene["stages"][0]["turn"] = 0.0
    outcome = solve(scene)
    assert outcome.outcome == "wrong"
    assert "crossed" in outcome.kind


@serial
def test_comparison_detects_penetration_of_a_body(monkeypatch):
    """The block penetrates the slab by 0.5 between the two quadrature points of the slab's top."""
    monkeypatch.setattr(TunnellingCheck, "evaluate", lambda self, before: {})
    scene = copy.deepcopy(TWO)
    scene["contacts"][0]["obstacle"] |= {"body": 1, "side": "bottom"}
    scene["contacts"][0] |= {"body": 0, "side": "top"}
    scene["bodies"][0]["n"], scene["contacts"][0]["quadrature"] = [1, 2], 2
    scene["stages"] = [dict(scene["stages"][0], normal=9.0)]
    outcome = solve(scene)
    assert outcome.outcome == "wrong"
    assert "penetration" in outcome.kind


@serial
def test_large_motion_with_small_kinematics_is_detected():
    """A disc pressed against the block moves sideways with it, by half its radius."""
    scene = copy.deepcopy(ONE) | {"translation": [0.5, 0.0]}
    obstacle = {"kind": "ball", "clearance": 0.0, "radius": 1.0, "moving": "translated"}
    scene["contacts"][0]["obstacle"] = obstacle

    def modify(setup, problem):
        problem.small_displacement_tolerance = np.inf

    assert solve(scene).outcome == "refused"
    outcome = solve(scene, modify=modify)
    assert outcome.outcome == "wrong"
    assert "kinematics" in outcome.kind


# ---- the command ---------------------------------------------------------------------------------


@serial
def test_seeds_reproduce_and_features_can_be_left_out():
    one = [fuzz_scenes.draw(s) for s in range(30)]
    assert one == [json.loads(json.dumps(fuzz_scenes.draw(s))) for s in range(30)]
    assert any(s["units"] != [1.0, 1.0] for s in one)
    for scenes in (finite_scenes, sliding_scenes):
        drawn = [scenes.draw(s) for s in range(30)]
        assert drawn == [json.loads(json.dumps(scenes.draw(s))) for s in range(30)]
        assert {s.pop("form", "plain") for s in drawn} == set(fuzz_scenes.FORMS)
        assert drawn == [scenes.draw(s, without=("form",)) for s in range(30)]
    plain = [fuzz_scenes.draw(s, without=("units", "restart")) for s in range(30)]
    assert all(s["units"] == [1.0, 1.0] and "restart" not in s for s in plain)


@serial
def test_extreme_scenes_differ_in_their_bodies_only():
    """Ratios are up to 20 for facet widths (24 with rounding), and 1e3 to 1e6 for moduli."""
    ratios = []
    for seed in range(60):
        plain, unlike = (sliding_scenes.draw(seed, extreme=e) for e in (False, True))
        assert {name for name in plain if plain[name] != unlike[name]} == {"bodies"}
        slab, block = unlike["bodies"]
        wide = [body["size"][0] / body["n"][0] for body in (slab, block)]
        ratios.append([wide[0] / wide[1], slab["E"] / block["E"]])
    log = np.log10(ratios)
    assert np.abs(log[:, 0]).max() < np.log10(24) and np.ptp(log[:, 0]) > 2
    assert 3 <= np.abs(log[:, 1]).min() and np.abs(log[:, 1]).max() <= 6.01
    assert np.ptp(log[:, 1]) > 9


@serial
def test_minimise_removes_irrelevant_features():
    scene = copy.deepcopy(ONE) | {"method": "newton", "units": [1e3, 1e-3], "weight": 0.1}
    scene["contacts"][0]["gap"] = -0.001
    minimised = fuzz.minimise(scene, lambda s: "gap" in s["contacts"][0])
    assert minimised["contacts"][0]["gap"] == -0.001
    assert minimised["contacts"][0]["law"]["kind"] == "frictionless"
    assert not {"method", "weight"} & set(minimised)
    assert minimised["units"] == [1.0, 1.0]
    assert len(minimised["stages"]) == 1
    assert minimised["bodies"][0]["n"] == [1, 1]


@pytest.mark.slow
@serial
def test_campaign_can_be_resumed(tmp_path):
    path = tmp_path / "results.csv"
    script = ROOT / "verification" / "fuzz.py"
    base = [sys.executable, str(script), "--resume", str(path), "--without", "space"]

    def seeds(n):
        done = subprocess.run(
            [*base, "--scenes", str(n)],
            env=subprocess_environment(),
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode in (0, 1), done.stderr
        with path.open(newline="") as file:
            return [int(row["seed"]) for row in csv.DictReader(file)]

    assert seeds(2) == [0, 1]
    assert seeds(3) == [0, 1, 2]
    text = fuzz.make_table([str(path)])
    assert text.startswith("3 scenes")
    assert "| all | 3 |" in text


@serial
def test_campaign_page_agrees_with_stored_outcomes():
    """The page in docs/ equals the one generated from the stored outcomes."""
    assert campaigns.page(campaigns.read_campaigns()) == campaigns.PAGE.read_text()


# ---- the independent solver ----------------------------------------------------------------------


def point_spring():
    """Return a problem of one node on unit springs above a floor (two dofs)."""
    body = reference_geometry.Body(
        cell="triangle",
        degree=1,
        x=np.zeros((1, 2)),
        vertices=np.zeros((0, 3), dtype=int),
        nodes=np.zeros((0, 3), dtype=int),
        nodes_x=np.zeros((1, 2)),
        body_numbers=np.zeros(1, dtype=int),
        stiffness=np.eye(2),
    )
    normal = np.array([[0.0, -1.0]])
    contact = reference.ContactModel(
        x=np.zeros((1, 2)),
        gap_function=lambda s: (0.5 + normal @ s, normal + 0 * s),
        interpolation=np.ones((1, 1)),
        weights=np.ones(1),
        k_n=np.ones(1),
        k_t=np.full(1, 0.5),
        law=reference_laws.Law("coulomb", friction=0.5),
        paired=np.ones(1, dtype=bool),
    )
    return reference.Problem(body, [contact])


@serial
def test_reference_reproduces_load_history_of_a_point():
    # Code_Aster SSND116A; displacements printed to six digits.
    problem = point_spring()
    u, motion, old = np.zeros(2), np.zeros(0), [problem.contacts[0].initial_state()]
    wanted = {
        (0.0, -0.5): (0.0, -0.5),
        (0.0, -1.0): (0.0, -0.75),
        (0.2, -1.0): (0.133333, -0.75),
        (2.0, -1.0): (1.875, -0.75),
        (1.8, -1.0): (1.741667, -0.75),
        (0.0, -1.0001): (0.125, -0.75),
    }
    for force, expected in wanted.items():
        push = np.array([force[0], round(force[1], 2)])
        none = np.zeros(0, dtype=int)
        load = reference.Load(push, none, np.zeros(0), [np.zeros(2)], [np.zeros(2)])
        u, motion, old = problem.solve(u, motion, load, old)
        computed = problem.evaluate(u, motion, load, old)
        old = [problem.contacts[0].next_state(computed[0], old[0])]
        assert np.allclose(u, expected, atol=1e-6)


@serial
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
@pytest.mark.parametrize("degree", [1, 2])
def test_reference_passes_the_patch_test(cell, degree):
    # Non-matching meshes, ν = 0: the interface jump is p/k_n everywhere, the stress uniform.
    d = 2 if cell in ("triangle", "quadrilateral") else 3
    across = [1.0] * (d - 1)
    scene = copy.deepcopy(ONE) | {"layout": "pair", "cell": cell, "degree": degree, "nu": 0.0}
    lower = {"origin": [0.0] * d, "size": [*across, 0.4], "n": [1] * d, "E": 1000.0, "jitter": 0}
    upper = lower | {"origin": [0.0] * (d - 1) + [0.4], "size": [*across, 0.6], "n": [2] * d}
    obstacle = {"kind": "body", "update_pairs": "never", "body": 1, "side": "bottom"}
    law = {"kind": "frictionless", "k_n": ["number", 3.0]}
    scene |= {
        "bodies": [lower, upper],
        "contacts": [{"body": 0, "side": "top", "obstacle": obstacle, "law": law}],
        "dirichlet": [
            [0, "bottom", list(range(d)), "fixed"],
            [1, "left", list(range(d - 1)), "fixed"],
        ],
        "drive": "force",
        "stages": [{"steps": 1, "normal": 1.0, "side": 0.0, "across": 0.0}],
    }
    problem, _, loads = fuzz_reference.make_problem(scene)
    load = loads(0, 1.0)
    none = np.zeros(problem.body.nodes_x.size)
    u, motion, old = problem.solve(none, np.zeros(0), load, [problem.contacts[0].initial_state()])
    computed = problem.evaluate(u, motion, load, old)[0]
    pressure = 1e-3 * 1000.0
    assert np.allclose(-computed["r_n"], pressure, rtol=1e-9)
    assert np.allclose(computed["overclosure"], pressure / 3000.0, rtol=1e-9)
    top = problem.body.nodes_x[:, -1] > 1 - 1e-9
    assert np.allclose(u.reshape(-1, d)[top, -1], -1e-3 - pressure / 3000.0, rtol=1e-9)


@serial
@pytest.mark.parametrize("modes", [3, 4, 6, 8])
def test_reference_projects_onto_nearest_point_of_polygon(modes):
    # σ is nearest to σ* in a convex set if (σ* - σ)·(v - σ) ≤ 0 for all corners v.
    rng = np.random.default_rng(1)
    trial, limit = rng.normal(size=(200, 2)), rng.uniform(0.1, 2, 200)
    sigma = reference_laws.project_onto_polygon(trial, limit, modes)
    angles = np.pi * (2 * np.arange(modes) + 1) / modes
    corners = np.column_stack([np.cos(angles), np.sin(angles)]) / np.cos(np.pi / modes)
    for corner in corners:
        ahead = limit[:, None] * corner - sigma
        assert np.sum((trial - sigma) * ahead, axis=1).max() < 1e-12
    sides = 2 * np.pi * np.arange(modes) / modes
    outward = np.column_stack([np.cos(sides), np.sin(sides)])
    assert (sigma @ outward.T - limit[:, None]).max() < 1e-12


@serial
def test_reference_derivatives_agree_with_finite_differences():
    law = reference_laws.Law("coulomb", friction=0.4, transverse=0.2, direction=(1.0, 0.3, 0.0))
    rng = np.random.default_rng(3)
    n = 20
    normal = np.tile([0.1, -0.2, -1.0], (n, 1)) / np.linalg.norm([0.1, -0.2, -1.0])
    contact = reference.ContactModel(
        x=np.zeros((n, 3)),
        gap_function=lambda s: (np.full(n, 0.1) + normal @ s, normal + 0 * s),
        interpolation=np.eye(n),
        weights=np.ones(n),
        k_n=np.full(n, 5.0),
        k_t=np.full(n, 3.0),
        law=law,
        paired=np.ones(n, dtype=bool),
    )
    old = reference.State(rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))
    jump, shift = rng.normal(size=(n, 3)), rng.normal(size=3)
    by_jump, by_shift = contact.derivatives(jump, shift, old)
    h = 1e-6
    for i in range(3):
        move = h * np.eye(3)[i]
        ends = [contact.evaluate(jump + s * move, shift, old)["traction"] for s in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / (2 * h), by_jump[:, :, i], atol=1e-6)
        ends = [contact.evaluate(jump, shift + s * move, old)["traction"] for s in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / (2 * h), by_shift[:, :, i], atol=1e-6)
