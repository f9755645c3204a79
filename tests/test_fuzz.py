"""Random scenes against a second solution; that solution against closed answers; and its eyes.

Tolerances of the comparison are those of ``verification/fuzz_judge.py``.
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
from scenes.processes import ROOT, environment
from verification import (
    campaigns,
    finite_reference,
    finite_scenes,
    fuzz,
    fuzz_features,
    fuzz_models,
    fuzz_scenes,
    present_scenes,
    reference_geometry,
    reference_laws,
)
from verification import reference_solver as reference

COMM = MPI.COMM_WORLD
serial = pytest.mark.skipif(COMM.size > 1, reason="nothing here depends on ranks")
SCENES = json.loads((ROOT / "verification" / "fuzz_regressions.json").read_text())
# Found wrong, and mended since; those that are not yet say so, some of one rank only.
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


def played(scene, **options):
    """Outcome of a scene on all ranks, the same on each."""
    outcome = fuzz.play(copy.deepcopy(scene), COMM if COMM.size > 1 else None, **options)
    return COMM.bcast(outcome)


# ---- scenes --------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize(
    "part", [part if part < 5 else pytest.param(part, marks=pytest.mark.slow) for part in range(10)]
)
def test_scenes_are_not_wrong(part):
    # All of them on one rank, a fifth on several, where a scene takes longer.
    for scene in SCENES["scenes"][part::10][:: 1 if COMM.size == 1 else 5]:
        outcome = played(scene)
        assert outcome.outcome in FINE, f"{outcome}\n{json.dumps(scene)}"


FINITE = [*SCENES["finite"], *SCENES["bodies"]]


@pytest.mark.mpi
@pytest.mark.parametrize("number", range(len(FINITE)))
def test_scenes_of_finite_kinematics_are_right(number):
    """Obstacles that move and turn, linear bodies and rubber, two bodies; on several ranks some.

    On one rank they are solved, too, and most are the solution found apart.
    """
    if COMM.size > 1 and number % 4:
        pytest.skip("takes longer on several ranks")
    scene = FINITE[number]
    outcome = played(scene)
    assert outcome.outcome in FINE, f"{outcome}\n{json.dumps(scene)}"
    if COMM.size == 1:
        assert outcome.outcome == "right"
        assert outcome.increments and {"equations", "apart", "nearest"} <= set(outcome.worst)


@pytest.mark.mpi
@pytest.mark.parametrize("seed", [720024, 720031, 720034, 720046])
def test_a_body_that_hovers_between_two_others_is_set_down(seed):
    """A block between one that is moved and a cavity: nothing holds it until both bear.

    Without load it is at rest anywhere between the two, and a method that drags one surface past
    the other on its way finds it where they cross between the points of Γc, which is refused.
    """
    without = ("multipliers", "motion", "accuracy", "method", "ration", "restart", "units")
    scene = fuzz_scenes.draw(seed, without=(*without, "increment"), family=seed // 24)
    outcome = played(scene)
    assert outcome.outcome in ("right", "another"), outcome


@serial
def test_a_refusal_that_another_method_contradicts_is_counted(monkeypatch):
    """The methods are asked one after another, each alone, and what is not right is no answer."""
    asked = []

    def play(scene, comm=None, **_):
        assert scene["ration"]
        asked.append(scene["method"])
        outcome = {"newton": "refused", "continuation": "wrong"}.get(scene["method"], "another")
        return fuzz.Outcome(outcome, "", 1, 0.0, [], {})

    monkeypatch.setattr(fuzz, "play", play)
    assert fuzz.contradicted({"seed": 1}) == "primal_dual"
    assert asked == ["newton", "continuation", "primal_dual"]


@serial
def test_a_step_across_the_residual_is_no_solution():
    """An obstacle held by a prescribed pressure alone: PETSc's line search ends all where F·y = 0.

    An attempt that it ends so has a residual as large as the forces.
    """
    name = "an obstacle that a prescribed pressure alone holds"
    scene = next(e["scene"] for e in SCENES["regressions"] if e["name"] == name)
    outcome = played(scene | {"method": "newton"})
    assert outcome.outcome == "refused"
    assert "Tried: newton: no progress (0 iterations). " in outcome.detail[0]
    outcome = played(scene)
    assert outcome.outcome == "refused"
    assert "converged (" not in outcome.detail[0]


@serial
def test_most_scenes_are_solved_and_compared():
    # A machine that refuses everything, or compares nothing, would pass the test above.
    found = [(scene["seed"], played(scene)) for scene in SCENES["scenes"][::7]]
    solved = [(seed, o) for seed, o in found if o.outcome in ("right", "another")]
    assert len(solved) > 0.7 * len(found)
    for seed, outcome in solved:
        # Of two scenes the first increment is not solved apart, the nearest exact solution is.
        wanted = {"equations", "nearest"} | ({"apart"} if seed not in (600094, 600209) else set())
        assert outcome.increments and wanted <= set(outcome.worst), seed


@pytest.mark.mpi
@pytest.mark.parametrize("entry", REGRESSIONS)
def test_scenes_that_were_wrong(entry):
    outcome = played(entry["scene"])
    assert outcome.outcome in entry.get("allowed", FINE), outcome


@pytest.mark.mpi
@pytest.mark.parametrize("form", fuzz_scenes.FORMS[1:])
def test_forms_are_written_in_many_ways(form):
    """Bodies of two materials, linear and of rubber, each form of them: as the one with E by cell.

    Cells are tagged by body and half, facets by their sides.
    """
    if COMM.size > 1 and form not in ("pairs", "beside"):
        pytest.skip("takes longer on several ranks")
    linear = next(s for s in SCENES["scenes"] if s["seed"] == 600052) | {"weight": 0.1}
    rubber = next(s for s in SCENES["bodies"] if s["seed"] == 2419)
    for scene in (linear, rubber):
        outcome = played(scene | {"form": form})
        assert outcome.outcome == "right", f"{outcome}\n{json.dumps(scene)}"


# ---- that the comparison sees --------------------------------------------------------------------

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
    "holds": [[0, "top", [0, 1], "moved"]],
    "strain": 1e-3,
    "share": 1.0,
    "stages": [
        {"steps": 1, "normal": 1.0, "side": 0.0, "across": 0.0},
        {"steps": 2, "normal": 1.0, "side": 0.4, "across": 0.0},
    ],
}


@serial
def test_a_good_scene_is_right():
    assert played(ONE).outcome == "right"


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
    ("spoiled", "check"),
    [
        (_move_a_node, "equations"),
        (_more_force, "reported N"),
        (_less_pressure, "reported traction"),
        (_more_work, "energy work"),
    ],
)
def test_a_spoiled_result_is_found(spoiled, check):
    outcome = played(ONE, spoiled=spoiled)
    assert outcome.outcome == "wrong"
    assert check in outcome.kind


def spoiling(spoil):
    """A change by which every commit leaves the history with what ``spoil`` makes of it."""

    def changed(made, problem):
        commit, history = problem.commit, problem.contacts[0].history

        def spoiled():
            commit()
            values = {n: history.values(n) for n in history.names}
            history.assign(values | spoil(history))

        problem.commit = spoiled

    return changed


def _forget_some_traction(history):
    return {"traction": 0.999 * history.values("traction")}


@serial
def test_a_spoiled_history_is_found():
    outcome = played(ONE, changed=spoiling(_forget_some_traction))
    assert outcome.outcome == "wrong"
    assert "equations" in outcome.kind


@serial
def test_another_friction_is_found():
    def changed(made, problem):
        made.scene = copy.deepcopy(made.scene)
        made.scene["contacts"][0]["law"]["friction"] = 0.3003

    # At the end half of the points slip.
    outcome = played(ONE, changed=changed)
    assert outcome.outcome == "wrong"


# A block pressed on a disc that is dragged and turned, so little that some points stick.
TURNING = copy.deepcopy(ONE) | {
    "kinematics": "finite",
    "bulk": "linear",
    "drive": "obstacle",
    "holds": [[0, "top", [0, 1], "still"]],
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


# A block pressed on a slab, dragged along it, and turned together with it; half of the points slip.
TWO = copy.deepcopy(TURNING) | {
    "kinematics": "present",
    "bulk": "rubber",
    "layout": "two",
    "drive": "prescribed",
    "bodies": [
        {"origin": [0.0, 0.0], "size": [2.0, 0.8], "n": [4, 2], "E": 100.0, "jitter": 3},
        {"origin": [0.7, 0.8], "size": [0.6, 0.6], "n": [3, 2], "E": 100.0, "jitter": 0},
    ],
    "holds": [[0, "bottom", [0, 1], "still"], [1, "top", [0, 1], "moved"]],
    "strain": 0.1,
    "stages": [
        {"steps": 2, "normal": 1.0, "side": 0.0, "across": 0.0, "turn": 0.0, "spin": 0.0},
        {"steps": 2, "normal": 1.0, "side": 0.05, "across": 0.0, "turn": 0.02, "spin": 0.7},
    ],
}
TWO["contacts"][0] |= {
    "body": 1,
    "obstacle": {"kind": "body", "update": "never", "body": 0, "side": "top"},
}
FAR = pytest.mark.parametrize("scene", [TURNING, TWO], ids=["obstacle", "bodies"])


@serial
@FAR
def test_a_good_scene_of_finite_kinematics_is_right(scene):
    assert played(scene).outcome == "right"


def _forget_a_turn(history):
    return {"traction": history.values("traction")[:, ::-1]}


def _slip_from_elsewhere(history):
    return {"jump": history.values("jump") + 1e-6}


@serial
@FAR
@pytest.mark.parametrize("spoil", [_forget_a_turn, _slip_from_elsewhere])
def test_a_spoiled_history_of_finite_kinematics_is_found(spoil, scene):
    """The traction with its components exchanged; slip counted from 1e-6 aside."""
    outcome = played(scene, changed=spoiling(spoil))
    assert outcome.outcome == "wrong"
    assert "equations" in outcome.kind


# A block that a wall guides, with one point a facet: in a cavity these hover, and are set down.
LOOSE = copy.deepcopy(TURNING) | {
    "bulk": "rubber",
    "drive": "force",
    "holds": [[0, "left", [0], "still"]],
    "stages": [
        {"steps": 2, "normal": 1.0, "side": 0.01, "across": 0.0, "turn": 0.0},
        {"steps": 1, "normal": 0.0, "side": 0.0, "across": 0.0, "turn": 0.0},
        {"steps": 1, "normal": 1.0, "side": 0.01, "across": 0.0, "turn": 0.0},
    ],
}
LOOSE["contacts"][0]["obstacle"]["kind"] = "cylinder inside"
LOOSE["contacts"][0]["quadrature"] = 5


@serial
def test_a_body_that_was_set_down_is_right():
    outcome = played(LOOSE)
    assert outcome.outcome == "right"
    assert {"set down rigid", "set down inside", "set down aloft", "apart"} <= set(outcome.worst)


def _deeper(u):
    u[:, -1] -= 1e-4


def _higher(u):
    u[:, -1] += 1e-4


def _wider(u):
    u[:, -1] += 1e-4 * u[:, 2]


@serial
@pytest.mark.parametrize(
    ("spoil", "check"), [(_deeper, "inside"), (_higher, "aloft"), (_wider, "rigid")]
)
def test_a_body_set_down_elsewhere_is_found(spoil, check):
    def spoiled(record):
        if record["contacts"][0]["set_down"] is not None:
            spoil(record["contacts"][0]["set_down"]["u"])

    outcome = played(LOOSE, spoiled=spoiled)
    assert outcome.outcome == "wrong"
    assert f"set down {check}" in outcome.kind


@serial
def test_slip_of_bodies_that_is_not_turned_is_found():
    """The committed traction stays in space while both bodies turn."""

    def changed(made, problem):
        present = problem.contacts[0].pairs
        present.turned = lambda vectors: vectors

    outcome = played(TWO, changed=changed)
    assert outcome.outcome == "wrong"
    assert "equations" in outcome.kind


@serial
@pytest.mark.parametrize("what", ["angle", "shift"])
def test_an_obstacle_that_is_elsewhere_is_found(what):
    """It turns or moves by a thousandth more than the scene says."""

    def changed(made, problem):
        apply, value = made.apply, getattr(made, what)

        def more(stage, t):
            apply(stage, t)
            value.value = 1.001 * value.value

        made.apply = more

    assert played(TURNING, changed=changed).outcome == "wrong"


@pytest.mark.whole
@serial
@pytest.mark.parametrize("kind", finite_scenes.KINDS)
def test_shapes_of_the_second_solution(kind):
    """Distances have slope 1, along their normals: by differences, 1e-6; in the plane and in space.

    At places around the lowest corner of the body, near the obstacle and not at its edges.
    """
    for d in (2, 3):
        if d == 2 and kind in ("torus", "turned profile"):
            continue
        obstacle = {"kind": kind, "clearance": 0.01, "radius": 1.3, "points": 24, "flat": 0.8}
        body = {"origin": [0.0] * d, "size": [1.0, 1.1, 0.9][:d], "n": [1] * d}
        scene = {"bodies": [body], "units": [1.0, 1.0]}
        contact = {"side": "bottom", "obstacle": obstacle}
        shape = finite_reference.shape_of(scene, contact)
        x = np.random.default_rng(2).uniform(-0.05, 0.05, (40, d)) + 0.4 * (np.arange(d) < d - 1)
        distance, normal = shape(x)
        assert np.abs(distance).max() < 1.0
        assert np.allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
        slope = np.zeros_like(x)
        for i in range(d):
            way = 1e-6 * np.eye(d)[i]
            slope[:, i] = (shape(x + way)[0] - shape(x - way)[0]) / 2e-6
        off = np.linalg.norm(slope + normal, axis=1)
        # Where the closest facet changes the difference is of two of them.
        assert np.sum(off > 1e-6) <= (2 if kind == "facets" else 0)


@serial
def test_a_raw_error_counts_as_a_crash_and_a_refusal_as_a_refusal():
    def raises(made, problem):
        raise KeyError("k_n")

    assert played(ONE, changed=raises).outcome == "crashed"
    bad = copy.deepcopy(ONE)
    bad["holds"], bad["drive"] = [], "force"
    bad["stages"][0]["normal"] = -1.0
    outcome = played(bad)
    assert outcome.outcome == "refused"
    assert outcome.kind.startswith("ValueError: ")


# ---- additional features -------------------------------------------------------------------------

# A block with its top held, and a thin plate below it that is led up.
PLATE = copy.deepcopy(ONE) | {
    "drive": "obstacle",
    "holds": [[0, "top", [0, 1], "still"]],
    "stages": [{"steps": 1, "normal": 2.0, "side": 0.0, "across": 0.0}],
    "cuts": 0,
}
PLATE["contacts"][0]["obstacle"] = {
    **{"kind": "rod", "shape": "plate", "radius": 0.01, "half": 0.4, "tilt": 0.0},
    **{"at": 0.5, "clearance": 0.001, "moving": "displacement"},
}


def _through():
    """The plate is led 0.3 through the bottom of the block."""
    scene = copy.deepcopy(PLATE)
    scene["stages"][0]["normal"] = 300.0
    return scene


@serial
@pytest.mark.parametrize("busy", fuzz_features.BUSY)
def test_a_scene_beside_an_unrelated_body_is_right(busy):
    assert played(ONE | {"busy": busy}).outcome == "right"


@serial
@pytest.mark.parametrize("scene", [ONE, TURNING, TWO], ids=["small", "obstacle", "bodies"])
def test_a_scene_that_is_carried_far_is_right(scene):
    carried = copy.deepcopy(scene) | {"carry": [20.0, 5.0]}
    if scene is not TWO:
        carried["contacts"][0]["obstacle"].setdefault("moving", "carried")
    assert played(carried).outcome == "right"


@serial
def test_a_plate_that_is_pressed_is_right_and_one_led_through_is_refused():
    assert played(PLATE).outcome == "right"
    assert played(_through()).outcome == "refused"


@serial
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_a_plate_that_passes_unseen_is_found(kinematics, monkeypatch):
    monkeypatch.setattr(TunnellingCheck, "evaluate", lambda self, before: {})
    scene = _through()
    if kinematics == "finite":
        scene |= {"kinematics": "finite", "bulk": "linear"}
        scene["stages"][0]["turn"] = 0.0
    outcome = played(scene)
    assert outcome.outcome == "wrong"
    assert "crossed" in outcome.kind


@serial
def test_a_body_that_is_passed_through_unseen_is_found(monkeypatch):
    """The block goes 0.5 deep into the slab, between the two points of its top."""
    monkeypatch.setattr(TunnellingCheck, "evaluate", lambda self, before: {})
    scene = copy.deepcopy(TWO)
    scene["contacts"][0]["obstacle"] |= {"body": 1, "side": "bottom"}
    scene["contacts"][0] |= {"body": 0, "side": "top"}
    scene["bodies"][0]["n"], scene["contacts"][0]["quadrature"] = [1, 2], 2
    scene["stages"] = [dict(scene["stages"][0], normal=9.0)]
    outcome = played(scene)
    assert outcome.outcome == "wrong"
    assert "penetration" in outcome.kind


@serial
def test_motion_that_is_not_small_is_found():
    """A disc pressed against the block is led aside by its radius together with it."""
    scene = copy.deepcopy(ONE) | {"carry": [0.5, 0.0]}
    obstacle = {"kind": "ball", "clearance": 0.0, "radius": 1.0, "moving": "carried"}
    scene["contacts"][0]["obstacle"] = obstacle

    def changed(made, problem):
        problem.small_displacement_tolerance = np.inf

    assert played(scene).outcome == "refused"
    outcome = played(scene, changed=changed)
    assert outcome.outcome == "wrong"
    assert "kinematics" in outcome.kind


# ---- the command ---------------------------------------------------------------------------------


@serial
def test_seeds_reproduce_and_features_can_be_left_out():
    one = [fuzz_scenes.draw(s) for s in range(30)]
    assert one == [json.loads(json.dumps(fuzz_scenes.draw(s))) for s in range(30)]
    assert any(s["units"] != [1.0, 1.0] for s in one)
    for scenes in (finite_scenes, present_scenes):
        drawn = [scenes.draw(s) for s in range(30)]
        assert drawn == [json.loads(json.dumps(scenes.draw(s))) for s in range(30)]
        assert {s.pop("form", "plain") for s in drawn} == set(fuzz_scenes.FORMS)
        assert drawn == [scenes.draw(s, without=("form",)) for s in range(30)]
    plain = [fuzz_scenes.draw(s, without=("units", "restart")) for s in range(30)]
    assert all(s["units"] == [1.0, 1.0] and "restart" not in s for s in plain)


@serial
def test_unlike_bodies_change_nothing_else_of_a_scene():
    """Facets up to 20 times as wide either way, by rounding 24, and moduli 1e3 to 1e6 times."""
    ratios = []
    for seed in range(60):
        plain, unlike = (present_scenes.draw(seed, extreme=e) for e in (False, True))
        assert {name for name in plain if plain[name] != unlike[name]} == {"bodies"}
        slab, block = unlike["bodies"]
        wide = [body["size"][0] / body["n"][0] for body in (slab, block)]
        ratios.append([wide[0] / wide[1], slab["E"] / block["E"]])
    log = np.log10(ratios)
    assert np.abs(log[:, 0]).max() < np.log10(24) and np.ptp(log[:, 0]) > 2
    assert 3 <= np.abs(log[:, 1]).min() and np.abs(log[:, 1]).max() <= 6.01
    assert np.ptp(log[:, 1]) > 9


@serial
def test_minimise_keeps_what_fails_and_nothing_else():
    scene = copy.deepcopy(ONE) | {"method": "newton", "units": [1e3, 1e-3], "weight": 0.1}
    scene["contacts"][0]["gap"] = -0.001
    found = fuzz.minimise(scene, lambda s: "gap" in s["contacts"][0])
    assert found["contacts"][0]["gap"] == -0.001
    assert found["contacts"][0]["law"]["kind"] == "frictionless"
    assert not {"method", "weight"} & set(found)
    assert found["units"] == [1.0, 1.0]
    assert len(found["stages"]) == 1
    assert found["bodies"][0]["n"] == [1, 1]


@pytest.mark.slow
@serial
def test_a_campaign_goes_on_where_it_was_ended(tmp_path):
    path = tmp_path / "results.csv"
    script = ROOT / "verification" / "fuzz.py"
    base = [sys.executable, str(script), "--resume", str(path), "--without", "space"]

    def seeds(n):
        done = subprocess.run(
            [*base, "--scenes", str(n)],
            env=environment(),
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode in (0, 1), done.stderr
        with path.open(newline="") as file:
            return [int(row["seed"]) for row in csv.DictReader(file)]

    assert seeds(2) == [0, 1]
    assert seeds(3) == [0, 1, 2]
    text = fuzz.table([str(path)])
    assert text.startswith("3 scenes")
    assert "| all | 3 |" in text


@serial
def test_page_of_campaigns_follows_from_stored_outcomes():
    """The page in docs/ is that of the stored outcomes."""
    assert campaigns.page(campaigns.campaigns()) == campaigns.PAGE.read_text()


# ---- the reference solver ------------------------------------------------------------------------


def point_spring():
    """One node on unit springs above a floor: a problem with two unknowns."""
    body = reference_geometry.Body(
        cell="triangle",
        degree=1,
        x=np.zeros((1, 2)),
        vertices=np.zeros((0, 3), dtype=int),
        nodes=np.zeros((0, 3), dtype=int),
        places=np.zeros((1, 2)),
        parts=np.zeros(1, dtype=int),
        stiffness=np.eye(2),
    )
    normal = np.array([[0.0, -1.0]])
    contact = reference.ContactModel(
        x=np.zeros((1, 2)),
        place=lambda s: (0.5 + normal @ s, normal + 0 * s),
        interpolation=np.ones((1, 1)),
        weights=np.ones(1),
        k_n=np.ones(1),
        k_t=np.full(1, 0.5),
        law=reference_laws.Law("coulomb", friction=0.5),
        paired=np.ones(1, dtype=bool),
    )
    return reference.Problem(body, [contact])


@serial
def test_reference_follows_the_history_of_a_point():
    # Code_Aster SSND116A; displacements printed to six digits.
    problem = point_spring()
    u, motion, old = np.zeros(2), np.zeros(0), [problem.contacts[0].start()]
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
        found = problem.respond(u, motion, load, old)
        old = [problem.contacts[0].next_state(found[0], old[0])]
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
    obstacle = {"kind": "body", "update": "never", "body": 1, "side": "bottom"}
    law = {"kind": "frictionless", "k_n": ["number", 3.0]}
    scene |= {
        "bodies": [lower, upper],
        "contacts": [{"body": 0, "side": "top", "obstacle": obstacle, "law": law}],
        "holds": [[0, "bottom", list(range(d)), "still"], [1, "left", list(range(d - 1)), "still"]],
        "drive": "force",
        "stages": [{"steps": 1, "normal": 1.0, "side": 0.0, "across": 0.0}],
    }
    problem, _, loads = fuzz_models.model(scene)
    load = loads(0, 1.0)
    none = np.zeros(problem.body.places.size)
    u, motion, old = problem.solve(none, np.zeros(0), load, [problem.contacts[0].start()])
    found = problem.respond(u, motion, load, old)[0]
    pressure = 1e-3 * 1000.0
    assert np.allclose(-found["r_n"], pressure, rtol=1e-9)
    assert np.allclose(found["closing"], pressure / 3000.0, rtol=1e-9)
    top = problem.body.places[:, -1] > 1 - 1e-9
    assert np.allclose(u.reshape(-1, d)[top, -1], -1e-3 - pressure / 3000.0, rtol=1e-9)


@serial
@pytest.mark.parametrize("modes", [3, 4, 6, 8])
def test_reference_returns_to_the_nearest_point_of_a_polygon(modes):
    # σ is nearest to σ* in a convex set if (σ* - σ)·(v - σ) ≤ 0 for all corners v.
    rng = np.random.default_rng(1)
    trial, limit = rng.normal(size=(200, 2)), rng.uniform(0.1, 2, 200)
    sigma = reference_laws.nearest_in_polygon(trial, limit, modes)
    angles = np.pi * (2 * np.arange(modes) + 1) / modes
    corners = np.column_stack([np.cos(angles), np.sin(angles)]) / np.cos(np.pi / modes)
    for corner in corners:
        ahead = limit[:, None] * corner - sigma
        assert np.sum((trial - sigma) * ahead, axis=1).max() < 1e-12
    sides = 2 * np.pi * np.arange(modes) / modes
    outward = np.column_stack([np.cos(sides), np.sin(sides)])
    assert (sigma @ outward.T - limit[:, None]).max() < 1e-12


@serial
def test_reference_derivatives_are_those_of_differences():
    law = reference_laws.Law("coulomb", friction=0.4, transverse=0.2, direction=(1.0, 0.3, 0.0))
    rng = np.random.default_rng(3)
    n = 20
    normal = np.tile([0.1, -0.2, -1.0], (n, 1)) / np.linalg.norm([0.1, -0.2, -1.0])
    contact = reference.ContactModel(
        x=np.zeros((n, 3)),
        place=lambda s: (np.full(n, 0.1) + normal @ s, normal + 0 * s),
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
        ends = [contact.respond(jump + s * move, shift, old)["traction"] for s in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / (2 * h), by_jump[:, :, i], atol=1e-6)
        ends = [contact.respond(jump, shift + s * move, old)["traction"] for s in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / (2 * h), by_shift[:, :, i], atol=1e-6)
