"""Rules of pairing, points without an opposite point, and penetration between points.

References are closed-form solutions or invariants. The solver's tolerance on forces is 1e-9, so
that solutions are accurate to 1e-8, and values computed from the same arrays to round-off.
"""

import warnings
from contextlib import contextmanager

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.checks.tunnelling import TunnellingCheck
from fenics_contact.checks.verdict import check_laws
from scenes import vtu
from scenes.bodies import Bodies, boxes
from scenes.comparison import assert_raised_on_all_ranks, is_close, shared_folder
from scenes.meshes import create_mesh
from scenes.stacks import FLOOR, LOWER, OUTSIDE, ROOF, SIDES, UPPER, E, joint, rings, stack
from scenes.tags import any_of, at_coordinate, at_interface, tag_by_midpoints

COMM = MPI.COMM_WORLD
BOTH = 40

pytestmark = pytest.mark.mpi


@contextmanager
def _assert_warning(expected, *words):
    """Assert that a warning with these words is given on every rank, or no warning at all."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    texts = [str(w.message) for w in caught if "opposite" in str(w.message)]
    is_reported = bool(texts) and all(word in texts[0] for word in words)
    assert all(flag == expected for flag in COMM.allgather(is_reported)), texts


# ---- opposite facets ----------------------------------------------------------------------------


def plates(cell, thickness, gap, *, layers=2, bend=None, degree=1):
    """Return axes and tags of plates of length 1 stacked vertically, tops and bottoms in BOTH."""
    d = 3 if cell in ("tetrahedron", "hexahedron") else 2
    axes, flats, low = [], [], 0.0
    counts = (6, 9, 7)
    for j in range(len(gap) + 1):
        high = low + thickness
        line = np.linspace(0, 1, counts[j] + 1)
        axes.append([line] * (d - 1) + [np.linspace(low, high, layers + 1)])
        flats += [low, high]
        low = high + (gap[j] if j < len(gap) else 0.0)
    marks = {BOTH: any_of(*(at_coordinate(d - 1, v) for v in flats))}
    for j in range(len(axes)):
        marks[10 * j + LOWER] = at_interface(d - 1, flats[2 * j + 1], above=False)
        marks[10 * j + UPPER] = at_interface(d - 1, flats[2 * j], above=True)
    return axes, marks


@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_plate_is_not_paired_with_its_own_back(cell, layers):
    """Plates of thickness 0.05 with a gap of 0.2, all tops and bottoms in one tag: no forces.

    Points at the gap have pairs, those of the outer faces have none.
    """
    axes, marks = plates(cell, 0.05, [0.2], layers=layers)
    marks = {BOTH: marks[BOTH]}
    body = Bodies(boxes(axes, marks, simplex=cell == "triangle"), E, 0.3)
    contact = body.contact(BOTH, BOTH, fc.Coulomb(0.3, 1e7, 1e7))
    contact.evaluate()
    assert contact.resultants().normal_force == 0.0
    points = contact.gather()
    height = points["x"][:, -1]
    inner = (height > 0.04) & (height < 0.26)
    assert np.all(np.isnan(points["gap"][~inner]))
    assert is_close(points["gap"][inner], np.full(inner.sum(), 0.2), 1e-12)
    assert contact.pairs.n_unpaired == np.count_nonzero(~inner)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_lifted_plates_have_no_contact_force(cell):
    """A plate is lifted by four times its thickness and lowered again, twice: springs in series."""
    sunk, k_n = 1e-3, 1e7
    axes, marks = plates(cell, 0.05, [0.0])
    d = len(axes[0])
    marks = {FLOOR: at_coordinate(d - 1, 0), UPPER: marks[10 + UPPER], LOWER: marks[LOWER]}
    marks[ROOF] = at_coordinate(d - 1, 0.1)
    body = Bodies(boxes(axes, marks, simplex=cell == "triangle"), E, 0.0)
    up = body.constant(0.0)
    body.prescribe(FLOOR, *range(d))
    body.prescribe(ROOF, *range(d - 1))
    body.prescribe(ROOF, d - 1, value=up)
    obstacle = fc.DeformableBody(body.tags, [LOWER, ROOF], update_pairs="increment")
    contact = body.contact(UPPER, obstacle, fc.Frictionless(k_n))
    problem = body.problem(contact)
    for height in (0.2, -sunk, 0.2, -sunk):
        up.value = height
        problem.solve()
        problem.commit()
        assert contact.pairs.n_unpaired == 0
        expected = 0.0 if height > 0 else sunk / (0.1 / E + 1 / k_n)
        assert is_close(contact.resultants().normal_force, expected, 1e-8, scale=1e3)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_three_plates_in_one_tag(cell):
    """Γc and obstacle are all faces of three thin plates: each joint transfers q, to 1e-8."""
    q, k_n = 5e3, 1e7
    axes, marks = plates(cell, 0.02, [0.0, 0.0], layers=1)
    d = 3 if cell == "hexahedron" else 2
    ends = any_of(*(at_coordinate(i, v) for i in range(d - 1) for v in (0.0, 1.0)))
    body = Bodies(boxes(axes, {BOTH: marks[BOTH], SIDES: ends}, simplex=cell == "triangle"), E, 0.0)
    space = body.u.function_space
    low = dolfinx.mesh.locate_entities_boundary(body.mesh, d - 1, lambda x: np.abs(x[d - 1]) < 1e-9)
    fixed_dofs = fem.locate_dofs_topological(space.sub(d - 1), d - 1, low)
    body.bcs = [fem.dirichletbc(body.constant(0.0), fixed_dofs, space.sub(d - 1))]
    body.prescribe(SIDES, *range(d - 1))
    top = ufl.conditional(ufl.gt(body.x[d - 1], 0.06 - 1e-9), 1.0, 0.0)
    body.F += q * top * body.v[d - 1] * body.ds(BOTH)
    contact = body.contact(BOTH, BOTH, fc.Frictionless(k_n))
    problem = body.problem(contact)
    problem.solve()
    points = contact.gather()
    inner = (points["x"][:, -1] > 1e-6) & (points["x"][:, -1] < 0.06 - 1e-6)
    assert contact.pairs.n_unpaired == np.count_nonzero(~inner)
    assert is_close(points["pressure"][inner], np.full(inner.sum(), q / 2), 1e-8)
    assert np.all(points["pressure"][~inner] == 0.0)


def test_long_facet_in_front_of_short_ones_is_paired():
    """Points are paired with the nearest facet, even if midpoints of many others are nearer."""
    axes = [
        [np.linspace(0, 1, 81), np.array([-0.05, 0.0])],
        [np.array([0.0, 1.0]), np.array([0.01, 0.02])],
        [np.linspace(0, 1, 8), np.array([0.03, 0.1])],
    ]
    sides = {
        LOWER: any_of(at_coordinate(1, 0.0), at_coordinate(1, 0.02)),
        UPPER: at_coordinate(1, 0.03),
    }
    body = Bodies(boxes(axes, sides), E, 0.3)
    contact = body.contact(UPPER, LOWER, fc.Frictionless(1e6))
    gap = contact.gather()["gap"]
    assert is_close(gap, np.full(len(gap), 0.01), 1e-12)


@pytest.mark.parametrize("opening", [0.0, 0.05])
def test_notch_faces_are_paired_up_to_the_root(opening):
    """Faces of a notch are paired, though of one body and with the root in common.

    A square of 2 × 2, cut from its right side to its middle; closed, or opened to a wedge.
    """
    contact = Bodies(cut_square(8, opening), E, 0.3).contact(FLOOR, ROOF, fc.Frictionless(1e7))
    assert contact.pairs.n_unpaired == 0
    points = contact.gather()
    assert np.all(points["gap"] >= -1e-12)
    assert (points["gap"].max() > 0.02) == (opening > 0)


def cut_square(n, opening):
    """Mesh [-1, 1]² with n × n cells, cut along y = 0 < x; FLOOR above the cut, ROOF below it."""
    line = np.linspace(-1, 1, n + 1)
    x = np.array([(a, b) for b in line for a in line])
    number = np.arange(len(x)).reshape(n + 1, n + 1)
    cells = np.column_stack(
        [number[i : n + i, j : n + j].ravel() for i in range(2) for j in range(2)]
    )
    cut = np.flatnonzero((np.abs(x[:, 1]) < 1e-12) & (x[:, 0] > 1e-12))
    duplicate = np.arange(len(x))
    duplicate[cut] = len(x) + np.arange(len(cut))
    above = x[cells].mean(axis=1)[:, 1] > 0
    cells[above] = duplicate[cells[above]]
    x = np.concatenate([x, x[cut] + np.column_stack([0 * cut, opening * x[cut, 0]])])
    mesh = create_mesh("quadrilateral", x, cells)

    def lip(side):
        return lambda x, cell: (
            (np.abs(x[:, 1]) < 0.06) & (x[:, 0] % 1 > 1e-9) & (side * cell[:, 1] > 0)
        )

    return mesh, tag_by_midpoints(mesh, {FLOOR: lip(1), ROOF: lip(-1), SIDES: at_coordinate(0, -1)})


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_interference_deeper_than_a_cell_is_paired(cell, kinematics):
    """Blocks that overlap by 0.2, twice the height of their cells, have pairs everywhere."""
    body = stack(cell, (10, 10) if cell == "triangle" else (4, 5), (0.5, 0.5), gap=-0.2)
    contact = joint(body, 1, fc.Frictionless(1e6), kinematics=kinematics)
    contact.evaluate()
    assert contact.pairs.n_unpaired == 0
    gap = contact.gather()["gap"]
    assert is_close(gap, np.full(len(gap), -0.2), 1e-12)


def test_max_initial_penetration():
    """A given ``max_initial_penetration`` bounds pairs; a negative one is refused."""
    body = stack("quadrilateral", (10, 10), (0.5, 0.5), gap=-0.2)
    law = fc.Frictionless(1e6)
    for release, unpaired in ((0.25, False), (0.15, True)):
        obstacle = fc.DeformableBody(body.tags, 10 + LOWER, max_initial_penetration=release)
        with _assert_warning(unpaired, "behind"):
            contact = body.contact(10 + UPPER, obstacle, law)
        assert (contact.pairs.n_unpaired > 0) == unpaired
    assert_raised_on_all_ranks(
        lambda: fc.DeformableBody(body.tags, 10 + LOWER, max_initial_penetration=-1.0),
        ValueError,
        "max_initial_penetration",
    )


def test_soft_contact_keeps_its_pairs():
    """Bodies with springs so soft that they overlap by several cells still have pairs."""
    body = stack("quadrilateral", (8, 10), (0.5, 0.5))
    body.prescribe(FLOOR, 0, 1)
    down = body.constant(0.0)
    body.prescribe(ROOF, 0)
    body.prescribe(ROOF, 1, value=down)
    obstacle = fc.DeformableBody(body.tags, 10 + LOWER, update_pairs="increment")
    contact = body.contact(10 + UPPER, obstacle, fc.Frictionless(1.0))
    problem = body.problem(contact)
    for depth in (0.02, 0.04, 0.08, 0.15, 0.25):
        down.value = -depth
        problem.solve()
        problem.commit()
        assert contact.pairs.n_unpaired == 0
        assert is_close(contact.resultants().normal_force, depth, 1e-4)


# ---- points without an opposite point ------------------------------------------------------------


def overhanging_block(cell, law, *, tags=(LOWER,), gap=-0.01, **options):
    """Set up a slab of width 1 on a pillar of 0.6, both clamped, with an interference of 0.01."""
    body = stack(cell, (5, 8), (0.5, 0.25), widths=[0.6, 1.0], nu=0.3)
    body.prescribe(FLOOR, *range(body.d))
    body.lift = body.constant(0.0)
    body.prescribe(ROOF, *range(body.d - 1))
    body.prescribe(ROOF, body.d - 1, value=body.lift)
    contact = joint(body, 1, law, gap=gap, **options)
    outside = np.any(np.abs(contact.gather()["x"][:, : body.d - 1] - 0.5) > 0.3, axis=1)
    assert 0 < contact.pairs.n_unpaired == np.count_nonzero(outside)
    return body, contact, outside


LAWS = {
    "frictionless": fc.Frictionless(1e7),
    "coulomb": fc.Coulomb(0.3, 1e7, 1e7),
    "bonded": fc.Foundation(1e7, 1e7),
    "loose": fc.Foundation(1e7, 1e7, tension=False),
    "tresca": fc.Tresca(0.3, 2e3, 1e7, 1e7),
    "prescribed": fc.Tresca(0.3, 2e3, k_t=1e7, unilateral=False),
}


@pytest.mark.each
@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_prescribed_gap_at_an_overhang(cell, name, enforcement):
    """Contact forces balance the reactions, 1e-7, for every law; overhanging points are open."""
    law = LAWS[name]
    if enforcement == "augmented" and (law.is_physical or cell == "hexahedron"):
        pytest.skip("no multipliers for a physical layer; once is enough")
    body, contact, outside = overhanging_block(cell, law, enforcement=enforcement)
    problem = body.problem(contact)
    for lift in (-0.002, 0.001):
        body.lift.value = lift
        step = problem.solve()
        r = step.contacts["joint 1"]
        obstacle = body.reaction(ROOF)
        assert np.abs(obstacle).max() > 1.0
        assert is_close(r.force, -obstacle, 1e-7)
        assert is_close(body.reaction(FLOOR), -obstacle, 1e-7)
        points = contact.gather()
        assert is_close(points["measure"] @ points["pressure"], r.normal_force, 1e-12)
        assert np.all(points["pressure"][outside] == 0.0)
        assert np.all(points["tangential_traction"][outside] == 0.0)
        assert np.all(points["status"][outside] == fc.Status.OPEN)
        assert np.array_equal(np.isnan(points["gap"]), outside)
        assert r.open >= np.count_nonzero(outside)
        opposed = points["measure"][~outside].sum()
        assert r.area <= opposed * (1 + 1e-12)
        if law.has_tension:
            assert is_close(r.area, opposed, 1e-12)
        energy = step.energy
        size = abs(energy.work) + abs(energy.elastic) + 1e-12
        assert abs(energy.imbalance) <= 1e-6 * size
        problem.commit()
    budget = fc.estimate_errors(problem, body.stress)
    assert all(np.isfinite(v) for part in budget.parts.values() for v in part.values())


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_files_mark_points_without_an_opposite_point(cell, tmp_path):
    """Where "paired" is 0, files have no gap (NaN), no pressure and the status open."""
    folder = shared_folder(tmp_path)
    body, contact, outside = overhanging_block(cell, fc.Coulomb(0.3, 1e7, 1e7))
    problem = body.problem(contact)
    problem.solve()
    fc.Writer(folder, problem).write(1)
    points = vtu.read_vtu(folder / "joint 1_points_0000.vtu").at_nodes
    alone = points["paired"][:, 0] == 0.0
    assert np.count_nonzero(alone) == np.count_nonzero(outside)
    assert np.array_equal(np.isnan(points["gap"][:, 0]), alone)
    facets = vtu.read_vtu(folder / "joint 1_0000.vtu")
    paired_fraction = facets.in_cells["paired"]
    assert np.array_equal(np.isnan(facets.at_nodes["gap"]).all(axis=1), paired_fraction == 0.0)
    assert np.isfinite(facets.at_nodes["gap"][paired_fraction > 0.0]).all()
    assert np.all(facets.at_nodes["pressure"][paired_fraction == 0.0] == 0.0)
    assert np.all(facets.in_cells["status"][paired_fraction == 0.0] == fc.Status.OPEN)
    assert facets.at_nodes["pressure"].min() == 0.0 < facets.at_nodes["pressure"].max()
    assert 0 < np.count_nonzero(paired_fraction == 0.0) < len(paired_fraction)


def test_tractions_of_unpaired_points_violate_the_laws():
    """A traction at a point without an opposite point violates complementarity."""
    _, contact, _ = overhanging_block("triangle", fc.Frictionless(1e7))
    contact.evaluate()
    assert check_laws(contact)["complementarity"] <= 1e-12
    contact.values.normal_traction[~contact.pairs.paired] = -1.0
    assert check_laws(contact)["complementarity"] > 1e-10


def test_warning_states_number_and_cause_of_unpaired_points():
    """If more than half of the points have no opposite point, all ranks warn, with the cause."""
    axes = [
        [np.linspace(0, 1, 9), np.linspace(0, 0.5, 3)],
        [np.linspace(0, 1, 9), np.linspace(0.6, 1, 3)],
    ]
    sides = {
        LOWER: at_coordinate(1, 0.5),
        UPPER: at_coordinate(1, 0.6),
        ROOF: at_coordinate(1, 1.0),
        FLOOR: at_coordinate(1, 0.0),
    }
    body = Bodies(boxes(axes, sides), E, 0.3)
    law = fc.Frictionless(1e6)

    def make_contact(slave, master, **options):
        return body.contact(slave, fc.DeformableBody(body.tags, master, **options), law)

    with _assert_warning(False):
        assert make_contact(UPPER, LOWER).pairs.n_unpaired == 0
    for slave, master, options, word in (
        (UPPER, LOWER, {"search_distance": 0.05}, "search_distance"),
        (UPPER, ROOF, {}, "own body"),
        (LOWER, ROOF, {}, "do not meet"),
        (ROOF, FLOOR, {}, "behind"),
    ):
        with _assert_warning(True, "16 of the 16 points", word):
            assert make_contact(slave, master, **options).pairs.n_unpaired == 16


# ---- penetration between the points --------------------------------------------------------------


def undetected(step):
    """Return the failures of the verdict's check of penetration and tunnelling."""
    conditions = (c for name, t in step.verdict.tunnelling.items() for c in t.conditions(name))
    return [each.failure for each in conditions if not each.holds]


def indented_block(cell, width, depth, *, coarse=2, swap=False, both=False, raised=0.0, fine=2):
    """Set up a block with ``coarse`` cells at its top, and a narrow indenter above a facet.

    Γc has two points along a side of a facet, however small the opposite facets are.
    """
    d = 3 if cell in ("hexahedron", "tetrahedron") else 2
    wide = np.linspace(0, 1, coarse + 1)
    where = 0.5 / coarse
    narrow = np.linspace(where - width / 2, where + width / 2, fine + 1)
    axes = [
        [wide] * (d - 1) + [np.linspace(0, 0.5, 3)],
        [narrow] * (d - 1) + [0.5 + raised + np.linspace(0, width, 3)],
    ]
    low, high = 0.5, 0.5 + raised
    sides = {
        FLOOR: at_coordinate(d - 1, 0),
        LOWER: at_interface(d - 1, low, above=False),
        UPPER: at_interface(d - 1, high, above=True),
        ROOF: at_coordinate(d - 1, high + width),
    }
    body = Bodies(boxes(axes, sides, simplex=cell == "triangle"), E, 0.3)
    body.prescribe(FLOOR, *range(d))
    down = body.constant(-depth)
    body.prescribe(ROOF, *range(d - 1))
    body.prescribe(ROOF, d - 1, value=down)
    faces = [(UPPER, LOWER)] if swap else [(LOWER, UPPER)]
    faces += [(UPPER, LOWER)] if both else []
    contacts = [
        body.contact(slave, master, fc.Frictionless(), name=f"side {i}", quadrature=2)
        for i, (slave, master) in enumerate(faces)
    ]
    return body, contacts, body.problem(*contacts)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_undetected_narrow_indenter_is_refused(cell):
    """An indenter of width 0.05 between points at a distance of 0.29 fails, with a remedy.

    With surfaces swapped, or Γc on both sides, contact forces balance the reaction, 1e-7.
    """
    body, contacts, problem = indented_block(cell, 0.05, 1e-3)
    text = assert_raised_on_all_ranks(
        problem.solve, fc.NotConverged, "penetrates", "swapped", "side 0"
    )
    assert "1.000e-03" in text
    assert contacts[0].resultants().normal_force == 0.0
    for options in ({"swap": True}, {"both": True}):
        body, contacts, problem = indented_block(cell, 0.05, 1e-3, **options)
        step = problem.solve()
        assert undetected(step) == []
        assert sum(r.normal_force for r in step.contacts.values()) > 1.0
        total = sum(r.normal_force for r in step.contacts.values())
        assert is_close(-total, body.reaction(ROOF)[body.d - 1], 1e-7)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("cells", [6, 12])
def test_obstacle_split_into_several_contacts(kinematics, cells):
    """Two slabs are under a block that overlaps the edge of the second one by 0.03.

    With facets of 0.2 no point is above the second slab, which penetrates the block: refused with a
    contact for each slab and with one for both. With facets of 0.1 a point is, and both have the
    same force with the same pairs, to the accuracy of the solution, 1e-8.
    """
    forces = []
    lines = [0.43 + np.linspace(0, 1.2, cells + 1), 0.5 + 0.2 * np.arange(4)]
    for tags in ([[LOWER, BOTH]], [[LOWER], [BOTH]]):
        axes = [[np.linspace(*ends, 4), np.array([0, 0.5])] for ends in ((0, 1.5), (1.6, 2.1))]
        sides = {
            FLOOR: at_coordinate(1, 0),
            BOTH: at_interface(1, 0.5, above=False),
            LOWER: lambda x, cell: at_interface(1, 0.5, above=False)(x, cell) & (x[:, 0] < 1.55),
            UPPER: at_interface(1, 0.5, above=True),
            ROOF: at_coordinate(1, 1.1),
        }
        body = Bodies(boxes([*axes, lines], sides), E, 0.3)
        body.prescribe(FLOOR, 0, 1)
        body.prescribe(ROOF, 0)
        body.prescribe(ROOF, 1, value=-0.01)
        slabs = [fc.DeformableBody(body.tags, tag, update_pairs="never") for tag in tags]
        contacts = [
            body.contact(UPPER, slab, fc.Frictionless(), kinematics=kinematics, name=f"slab {i}")
            for i, slab in enumerate(slabs)
        ]
        problem = body.problem(*contacts)
        if cells == 6:
            assert_raised_on_all_ranks(problem.solve, fc.NotConverged, "penetrates")
            continue
        step = problem.solve()
        assert undetected(step) == []
        forces.append(sum(c.resultants().normal_force for c in contacts))
    if cells > 6:
        assert forces[0] > 1.0
        assert forces[1] == pytest.approx(forces[0], rel=1e-8)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_undetected_pin_between_slabs_is_refused(kinematics):
    """A pin level with the slabs, in its own contact and between points of Γc, is refused."""
    width, high = 0.04, np.linspace(0, 0.5, 3)
    edges = (0.0, 0.9), (1.1, 2.0), (1 - width / 2, 1 + width / 2)
    axes = [[np.linspace(*ends, n), high] for ends, n in zip(edges, (5, 5, 3), strict=True)]
    axes += [[np.linspace(0.5, 1.5, 5), 0.5 + high]]
    sides = {
        FLOOR: at_coordinate(1, 0),
        LOWER: at_interface(1, 0.5, above=False),
        BOTH: lambda x, cell: (
            at_interface(1, 0.5, above=False)(x, cell) & (abs(x[:, 0] - 1) < width)
        ),
        UPPER: at_interface(1, 0.5, above=True),
        ROOF: at_coordinate(1, 1),
    }
    body = Bodies(boxes(axes, sides), E, 0.3)
    body.prescribe(FLOOR, 0, 1)
    body.prescribe(ROOF, 0)
    body.prescribe(ROOF, 1, value=-0.01)
    contacts = [
        body.contact(UPPER, tag, fc.Frictionless(), quadrature=2, kinematics=kinematics, name=name)
        for name, tag in (("slabs", LOWER), ("pin", BOTH))
    ]
    problem = body.problem(*contacts)
    assert_raised_on_all_ranks(problem.solve, fc.NotConverged, "pin: the obstacle penetrates")


def test_penetration_tolerance_of_the_verdict():
    """Penetration fails once the gap is closed, above a fiftieth of the smaller facet, 5e-4."""
    for depth, fails in ((0.0, False), (9e-4, False), (1.4e-3, False), (1.6e-3, True)):
        *_, problem = indented_block("triangle", 0.05, depth, raised=1e-3)
        if fails:
            assert_raised_on_all_ranks(problem.solve, fc.NotConverged, "penetrates")
        else:
            assert undetected(problem.solve()) == []


@pytest.mark.each
@pytest.mark.parametrize("counts", [(1, 20), (20, 1), (3, 20), (20, 3), (7, 8)])
@pytest.mark.parametrize("swap", [False, True])
def test_any_ratio_of_mesh_sizes_is_verified(counts, swap):
    """Blocks pressed eccentrically, so that one side opens: no undetected penetration."""
    body = stack("quadrilateral", counts, (0.5, 0.5), nu=0.3)
    body.prescribe(FLOOR, 0, 1)
    body.prescribe(ROOF, 0)
    top = fem.Function(body.u.function_space.sub(1).collapse()[0])
    spaces = body.u.function_space.sub(1), top.function_space
    dofs = fem.locate_dofs_topological(spaces, 1, body.tags.find(ROOF))
    body.bcs.append(fem.dirichletbc(top, dofs, spaces[0]))
    contact = joint(body, 1, fc.Coulomb(0.3), swap=swap)
    problem = body.problem(contact)
    for load_factor in (0.5, 1.0):
        top.interpolate(lambda x, load_factor=load_factor: load_factor * 0.01 * (x[0] - 0.4))
        step = problem.solve()
        problem.commit()
        assert undetected(step) == []
    assert contact.resultants().normal_force > 10


@pytest.mark.parametrize("counts", [(5, 9), (9, 5), (4, 40), (40, 4), (6, 6)])
@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("degree", [1, 2])
def test_faceting_of_curved_surfaces_is_accepted(counts, swap, degree):
    """Overlapping facets of rings of straight or curved cells pass the verdict, loaded or not."""
    body = rings(counts, degree=degree)
    body.prescribe(FLOOR, 0, 1)
    squeeze = body.constant(0.0)
    body.F += squeeze * ufl.dot(ufl.FacetNormal(body.mesh), body.v) * body.ds(OUTSIDE)
    slave, master = (UPPER, LOWER) if swap else (LOWER, UPPER)
    contact = body.contact(slave, master, fc.Coulomb(0.3))
    assert TunnellingCheck([contact]).evaluate(None)["contact"].place is None
    problem = body.problem(contact)
    for load in (1.0, 1e3):
        squeeze.value = load
        assert undetected(problem.solve()) == []
        problem.commit()


# ---- the true gap --------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_true_gap_of_a_rotated_block(cell):
    """The upper block is rotated by 0.3 and lifted: distance along the rotated normal to z = 0.5.

    The tolerance is round-off, 1e-12. The pairs are not updated.
    """
    body = stack(cell, (8, 4), (0.5, 0.25), widths=[3.0, 1.0])
    contact = joint(body, 1, fc.Frictionless(1e6))
    d, angle, lift = body.d, 0.3, 0.25
    turn = np.eye(d)
    turn[0, 0] = turn[-1, -1] = np.cos(angle)
    turn[0, -1], turn[-1, 0] = -np.sin(angle), np.sin(angle)
    pivot = np.full(d, 0.5)

    def moved(x):
        arm = x[:d] - pivot[:, None]
        return turn @ arm - arm + lift * np.eye(d)[:, -1:]

    body.set_displacement(moved, lambda x: x[:, -1] > 0.5)
    x = contact.points
    gap, normal = contact.true_placement()
    assert contact.pairs.n_updates == 1
    assert is_close(normal, np.tile(-turn[:, -1], (len(normal), 1)), 1e-12, scale=1.0)
    assert COMM.allreduce(np.count_nonzero(np.isnan(gap))) == 0
    height = (x + moved(x.T).T)[:, -1] - 0.5
    assert is_close(gap, height / np.cos(angle), 1e-12, scale=1.0)
    assert COMM.allreduce(np.abs(contact.gap - gap).max(initial=0.0), op=MPI.MAX) > 1e-3


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_projection_is_exact_in_rotated_bodies(cell):
    """A facet of the block, rotated by 0.3 and lifted, is above two facets of the other one.

    Their common node rises by 1. Projected onto linear functions of the facet, the displacement of
    the opposite points is its mean, 1 - cos(0.3) / 3, to round-off (1e-12).
    """
    body = stack(cell, (4, 1), (0.5, 1.0), widths=[3.0, 1.0])
    contact = joint(body, 1, fc.Frictionless(1e6), quadrature=2)
    d, angle, arm = body.d, 0.3, 0.75

    def rotated(x):
        along, up = x[0] - 0.5, x[d - 1] - 0.5
        cosine, sine = np.cos(angle) - 1, np.sin(angle)
        across = [0 * along] * (d - 2)
        return np.vstack([cosine * along - sine * up, *across, sine * along + cosine * up + 0.25])

    def raised(x):
        return np.vstack([*([0 * x[0]] * (d - 1)), np.maximum(1 - abs(x[0] - 0.5) / arm, 0)])

    body.set_displacement(rotated, lambda x: x[:, -1] > 0.5)
    contact.contact_kinematics.find_pairs(body.u, np.zeros(len(contact.points)))
    body.u.x.array[:] = 0.0
    contact.evaluate()
    before = contact.gap.copy()
    body.set_displacement(raised, lambda x: x[:, -1] < 0.51)
    contact.evaluate()
    exact = np.full(len(before), 1 - np.cos(angle) / 4 / arm)
    assert is_close(before - contact.gap, exact, 1e-12)
