"""Files for ParaView, read back by `scenes.vtu`, agree with known fields.

References: polynomials that the elements represent, met to round-off (1e-10 of the largest value),
and the contact's values at its quadrature points, which are written unchanged.
"""

import os

import numpy as np
import pytest
import ufl
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.surface.facet_values import facet_values
from scenes import vtu
from scenes.block_on_ball import BlockOnBall
from scenes.blocks import CELLS, GRID, dimension, polynomial
from scenes.comparison import assert_raised_on_all_ranks, is_close, shared_folder
from scenes.elasticity import stress
from scenes.histories import BlockOnBallHistory
from scenes.rubber import DiscOnRubber

COMM = MPI.COMM_WORLD

pytestmark = [pytest.mark.three_ranks, pytest.mark.timeout(120)]

# Reference coordinates, times two, of the nodes of a cell as defined by VTK's classes.
NODES = {
    21: "000 200 100",
    22: "000 200 020 100 110 010",
    28: "000 200 220 020 100 210 120 010 110",
    24: "000 200 020 002 100 110 010 001 101 011",
    29: "000 200 220 020 002 202 222 022 100 210 120 010 102 212 122 012 001 201 221 021 "
    "011 211 101 121 110 112 111",
}
LINEAR = {3: 21, 5: 22, 9: 28, 10: 24, 12: 29}
VTK = {"triangle": (5, 3), "quadrilateral": (9, 3), "tetrahedron": (10, 5), "hexahedron": (12, 9)}
# Volume of a reference cell, relative to the box that its edges span.
PART = {3: 1, 5: 1 / 2, 9: 1, 10: 1 / 6, 12: 1}


def reference(kind):
    """Return the reference coordinates of the nodes of a VTK cell type."""
    places = NODES[LINEAR.get(kind, kind)].split()
    places = np.array([[int(c) / 2 for c in place] for place in places])
    return places[np.all(places % 1 == 0, axis=1)] if kind in LINEAR else places


def linear_kind(kind):
    return {second: first for first, second in LINEAR.items()}.get(kind, kind)


def content(grid):
    """Return the total length, area or volume of the cells, from their corners."""
    kind = linear_kind(grid.kind)
    corners = len(reference(kind))
    x = grid.x[:, :corners]
    d = {3: 1, 5: 2, 9: 2, 10: 3, 12: 3}[kind]
    reference_nodes = reference(kind)
    points = np.array([[0.5 - 0.5 / 3**0.5], [0.5 + 0.5 / 3**0.5]])
    if kind in (5, 10):
        rule = np.full((1, d), 1 / (d + 1))
    else:
        rule = np.stack(np.meshgrid(*[points[:, 0]] * d), axis=-1).reshape(-1, d)
    total = 0.0
    for place in rule:
        if kind in (5, 10):
            slopes = np.vstack([-np.ones(d), np.eye(d)])
        else:
            factors = np.where(reference_nodes[:, :d] > 0, place, 1 - place)
            signs = np.where(reference_nodes[:, :d] > 0, 1.0, -1.0)
            slopes = np.stack(
                [signs[:, i] * np.delete(factors, i, axis=1).prod(axis=1) for i in range(d)], axis=1
            )
        jacobian = np.einsum("cni,nj->cij", x, slopes)
        gram = np.einsum("cij,cik->cjk", jacobian, jacobian)
        total += np.sqrt(np.linalg.det(gram)).sum() * PART[kind] / len(rule)
    return total


def in_plane(values, d):
    return values[..., :d]


@pytest.mark.parametrize("cell,degree", GRID)
def test_cells_nodes_and_fields_are_exact(cell, degree, tmp_path):
    """With shuffled cells, on any number of ranks, all of body and Γc is written exactly once."""
    folder, d = shared_folder(tmp_path), dimension(cell)
    setup = BlockOnBall(cell=cell, degree=degree, mesh={"n": 2, "shuffled": True})
    field = polynomial(d, degree, 3, 0.1)
    setup.scene.u.interpolate(field)
    tensor = stress(setup.scene.u, setup.scene.E, setup.scene.nu)
    fc.Writer(folder, setup.problem, stress=tensor).write(0.5)
    assert vtu.read_collection(folder / "body.pvd") == [(0.5, "body_0000.vtu")]

    body = vtu.read_vtu(folder / "body_0000.vtu")
    surface = vtu.read_vtu(folder / "contact_0000.vtu")
    kinds = VTK[cell] if degree == 1 else tuple(LINEAR[kind] for kind in VTK[cell])
    assert (body.kind, surface.kind) == kinds
    assert abs(content(body) - 1) <= 1e-12 and abs(content(surface) - 1) <= 1e-12
    assert np.abs(surface.x[..., d - 1]).max() <= 1e-15
    for grid in (body, surface):
        # Nodes are at their reference coordinates, interpolated from the corners.
        reference_nodes, corners = reference(grid.kind), reference(linear_kind(grid.kind))
        if linear_kind(grid.kind) in (5, 10):
            weights = np.column_stack(
                [1 - reference_nodes.sum(axis=1), reference_nodes[:, : corners.shape[1]]]
            )
            weights = weights[:, : len(corners)]
        else:
            weights = np.where(
                corners > 0, reference_nodes[:, None], 1 - reference_nodes[:, None]
            ).prod(axis=2)
        places = np.einsum("nk,cki->cni", weights, grid.x[:, : len(corners)])
        assert is_close(grid.x, places, 1e-14)
        exact = field(grid.x.reshape(-1, 3).T).T.reshape(*grid.x.shape[:2], d)
        assert is_close(in_plane(grid.at_nodes["displacement"], d), exact, 1e-12)
        assert np.all(grid.at_nodes["displacement"][..., d:] == 0)

    step = 1e-3  # central differences are exact for polynomials of degree 2
    x = body.x.reshape(-1, 3)[:, :d].T
    gradient = np.stack(
        [
            (field(x + step * e[:, None]) - field(x - step * e[:, None])) / 2 / step
            for e in np.eye(d)
        ]
    ).transpose(2, 1, 0)
    E, nu = 1000.0, 0.3
    strain = (gradient + gradient.transpose(0, 2, 1)) / 2
    trace = np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(d)
    exact = E / (1 + nu) * (strain + nu / (1 - 2 * nu) * trace)
    written = body.at_nodes["stress"].reshape(-1, 3, 3)
    assert is_close(written[:, :d, :d], exact, 1e-10)
    assert ("von_mises" in body.at_nodes) == (d == 3)
    if d == 3:
        s = exact - np.trace(exact, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3
        mises = np.sqrt(1.5 * np.einsum("nij,nij->n", s, s))
        assert is_close(body.at_nodes["von_mises"].ravel(), mises, 1e-10)


@pytest.mark.parametrize("cell", CELLS)
def test_values_at_points_and_facets(cell, tmp_path):
    """Points have the contact's values; facets stay within them and preserve the force."""
    folder, d = shared_folder(tmp_path), dimension(cell)
    setup = BlockOnBall(cell=cell, degree=2, mesh={"n": 3})
    setup.problem.small_displacement_tolerance = np.inf
    writer = fc.Writer(folder, setup.problem)
    for step in fc.increments(setup.problem, setup.load, 0, 2, steps=2):
        writer.write(step)
    contact = setup.contact
    expected = contact.gather()
    points = vtu.read_vtu(folder / "contact_points_0001.vtu")
    assert points.kind == 1 and points.numbers == {"load": 2.0}
    x = points.x[:, 0]
    order = np.lexsort(np.round(x[:, :d], 9).T[::-1])
    assert is_close(x[order][:, :d], expected["x"], 1e-12)
    computed = {name: values[order, 0] for name, values in points.at_nodes.items()}
    for name in ("pressure", "gap", "slip", "status"):
        assert np.array_equal(computed[name], expected[name]), name
    for name in ("normal", "tangential_traction"):
        assert np.array_equal(computed[name][:, :d], expected[name]), name
    shown = np.unique(computed["status"]).tolist()
    assert fc.Status.OPEN in shown and fc.Status.SLIP in shown

    facets = vtu.read_vtu(folder / "contact_0001.vtu")
    pressure = facets.at_nodes["pressure"]
    assert pressure.min() == 0.0 and pressure.max() <= expected["pressure"].max()
    # The force of a linear field on equal facets is the mean of its corner values.
    corners = {3: 2, 5: 3, 9: 4}[linear_kind(facets.kind)]
    force = pressure[:, :corners].mean(axis=1).sum() / len(pressure)
    assert is_close(force, step.contacts["contact"].normal_force, 1e-10)
    per_facet = len(points.x) // len(facets.x)
    by_facet = points.at_nodes["status"][:, 0].reshape(-1, per_facet)
    most = [np.bincount(row, minlength=3).argmax() for row in by_facet]
    assert np.array_equal(facets.in_cells["status"], most)
    # Facets and points are in the same order, with the same displacement.
    middle = points.x[:, 0].reshape(-1, per_facet, 3).mean(axis=1)
    assert is_close(facets.x[:, :corners].mean(axis=1), middle, 1e-12)
    moved = points.at_nodes["displacement"][:, 0]
    displacements = contact.pairs.own_displacement()
    comm = contact.surface.mesh.comm
    displacements = np.concatenate(comm.allgather(np.column_stack([contact.points, displacements])))
    displacements = displacements[np.lexsort(np.round(displacements[:, :d], 9).T[::-1])][:, d:]
    assert is_close(moved[order][:, :d], displacements, 1e-12)


def test_facet_values_stay_within_point_values():
    """Linear fields are exact between the points; no extrapolated value leaves their range."""
    rng = np.random.default_rng(1)
    gauss = 0.5 + 0.5 * np.array([-(0.6**0.5), 0.0, 0.6**0.5])
    weights = np.array([5, 8, 5]) / 18
    points = np.column_stack([gauss, 2 * gauss])[None].repeat(200, axis=0)
    measure = np.tile(weights, (200, 1))
    ends = np.array([[0.0, 0.0], [1.0, 2.0]])[None].repeat(200, axis=0)
    values = rng.uniform(-1, 1, (200, 3, 2)) ** 3
    values[0] = [[0.0, 1], [0.0, 2], [1000.0, 3]]
    computed = facet_values(points, measure, values, ends)
    assert np.all(computed >= values.min(axis=1, keepdims=True))
    assert np.all(computed <= values.max(axis=1, keepdims=True))
    assert is_close(computed.mean(axis=1), np.einsum("p,fpk->fk", weights, values), 1e-13)
    assert computed[0, 0, 0] == 0.0  # a linear fit gives -368 here
    assert is_close(computed[0, :, 1], [1.0, 3.0], 1e-13)  # increases along the whole facet
    # Linear fields are exact at the points.
    line = 3 - 2 * points[:, :, 0] + points[:, :, 1] ** 0
    assert is_close(facet_values(points, measure, line, points), line, 1e-13)
    # A single point gives a constant; points without a value are ignored.
    one = facet_values(points[:1, :1], measure[:1, :1], np.array([[7.0]]), ends[:1])
    assert one.tolist() == [[7.0, 7.0]]
    holes = np.array([[np.nan, 2.0, 4.0], [np.nan] * 3])
    computed = facet_values(points[:2], measure[:2], holes, ends[:2])
    assert computed[0] == pytest.approx((8 * 2 + 5 * 4) / 13) and np.isnan(computed[1]).all()
    assert facet_values(points[:0], measure[:0], values[:0], ends[:0]).shape == (0, 2, 2)


def files(folder):
    COMM.barrier()
    contents = {name: (folder / name).read_bytes() for name in sorted(os.listdir(folder))}
    COMM.barrier()
    return contents


def read_series(folder, name="floor"):
    """Return times, loads and largest pressures of a series."""
    states = [
        (time, vtu.read_vtu(folder / file))
        for time, file in vtu.read_collection(folder / f"{name}.pvd")
    ]
    return [(t, grid.numbers["load"], grid.at_nodes["pressure"].max()) for t, grid in states]


def test_resumed_history_continues_the_series(tmp_path):
    """No state is written twice or lost, and the files of earlier increments are unchanged."""
    folder = shared_folder(tmp_path)
    uninterrupted, setup = BlockOnBallHistory(), BlockOnBallHistory()
    writer = fc.Writer(folder / "whole", uninterrupted.problem)
    # Load and unload: loads occur twice, increments once.
    for step in uninterrupted.increments(4.0):
        writer.write(step)
    writer = fc.Writer(folder / "parts", setup.problem)
    for step in setup.increments(4.0, checkpoint=folder / "state.npz", checkpoint_every=2):
        writer.write(step)
        if step.increment == 5:  # one after the checkpoint, at increment 4
            break
    before = files(folder / "parts")
    resumed = BlockOnBallHistory()
    writer = fc.Writer(folder / "parts", resumed.problem)
    assert files(folder / "parts") == before
    for step in resumed.increments(4.0, checkpoint=folder / "state.npz"):
        if step.increment == 5:
            assert [time for time, *_ in read_series(folder / "parts")] == [1, 2, 3, 4, 5]
        writer.write(step)
    after, expected = read_series(folder / "parts"), read_series(folder / "whole")
    assert [row[:2] for row in after] == [row[:2] for row in expected]
    assert [row[0] for row in after] == [*range(1, 9)]
    assert is_close(
        [row[2] for row in after], [row[2] for row in expected], uninterrupted.tolerance
    )
    unchanged = [n for n in before if n.endswith(".vtu") and int(n[-8:-4]) < 4]
    assert len(unchanged) == 16
    now = files(folder / "parts")
    assert all(now[name] == before[name] for name in unchanged)

    # The first state of a new history replaces the series.
    fresh = BlockOnBallHistory()
    writer = fc.Writer(folder / "parts", fresh.problem)
    writer.write(next(iter(fresh.increments(4.0))))
    names = sorted(
        f"{n}{end}"
        for n in ("body", "floor", "floor_points", "floor_obstacle")
        for end in (".pvd", "_0000.vtu")
    )
    assert sorted(files(folder / "parts")) == names


def test_invalid_input_is_refused(tmp_path):
    """Errors on all ranks state the remedy; nothing is written."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBall()
    (folder / "file").touch()
    COMM.barrier()
    named = f"but {folder / 'file'} is a file; give another name"
    for taken in (folder / "file", folder / "file" / "in"):
        assert_raised_on_all_ranks(
            lambda taken=taken: fc.Writer(taken, setup.problem),
            (OSError, NotADirectoryError),
            named,
        )
    assert_raised_on_all_ranks(
        lambda: fc.Writer(folder, setup.contact), ValueError, "ContactProblem"
    )
    vector = setup.scene.u
    assert_raised_on_all_ranks(
        lambda: fc.Writer(folder, setup.problem, stress=vector), ValueError, "(2,)", "(3, 3)"
    )
    odd = BlockOnBall(contact={"name": "a/b"})
    assert_raised_on_all_ranks(lambda: fc.Writer(folder, odd.problem), ValueError, "a/b", "name")
    odd = BlockOnBall(contact={"name": "body"})
    assert_raised_on_all_ranks(lambda: fc.Writer(folder, odd.problem), ValueError, "body.pvd")
    assert sorted(files(folder)) == ["file"]
    writer = fc.Writer(folder, setup.problem)
    for state in (None, "1", float("nan"), True):
        assert_raised_on_all_ranks(lambda state=state: writer.write(state), ValueError, "time")
    writer.write(1)
    assert_raised_on_all_ranks(lambda: writer.write(1.0), ValueError, "must increase")
    if COMM.rank == 0:
        (folder / "contact.pvd").write_text("<broken")
    COMM.barrier()
    assert_raised_on_all_ranks(
        lambda: fc.Writer(folder, setup.problem), ValueError, "contact.pvd", "remove"
    )


def test_second_writer_in_a_folder_is_refused(tmp_path):
    """A second writer would overwrite files that are listed in the series of the first one."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBall()
    first, second = (fc.Writer(folder, setup.problem) for _ in range(2))
    first.write(1)
    before = files(folder)
    assert_raised_on_all_ranks(
        lambda: second.write(2), ValueError, "body.pvd", "another one writes"
    )
    assert files(folder) == before
    first.write(2)
    fc.Writer(folder, setup.problem).write(3)  # replaces the first writer
    assert_raised_on_all_ranks(lambda: first.write(4), ValueError, "one Writer per folder")
    assert [time for time, _ in vtu.read_collection(folder / "body.pvd")] == [1, 2, 3]


def test_failed_write_leaves_the_series_unchanged(tmp_path, monkeypatch):
    """After a failed write the series is unchanged, and the next write continues it."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBall()
    writer = fc.Writer(folder, setup.problem)
    writer.write(1)
    before = files(folder)
    replace, calls = os.replace, []

    def fail_to_write(*names):
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail_to_write)
        assert_raised_on_all_ranks(lambda: writer.write(2), OSError, "no space left")
    assert files(folder) == before and not calls and os.replace is replace
    writer.write(2)
    assert [time for time, _ in vtu.read_collection(folder / "contact.pvd")] == [1, 2]
    assert {**files(folder), **{n: before[n] for n in before if ".vtu" in n}} == files(folder)


def test_interior_displacement_is_recovered_before_writing(tmp_path):
    """With ``recover_interior="last"`` the file has the displacement of its increment, to 1e-8."""
    folder = shared_folder(tmp_path)
    grids = []
    for name, field in (("every", "every"), ("last", "last")):
        setup = BlockOnBall(condensation=True)
        setup.problem.small_displacement_tolerance = np.inf
        writer = fc.Writer(folder / name, setup.problem)
        for step in fc.increments(setup.problem, setup.load, 0, 1, steps=2, recover_interior=field):
            if step.increment == 1:
                assert step.complete == (field == "every")
                writer.write(step)
        grids.append(vtu.read_vtu(folder / name / "body_0000.vtu").at_nodes["displacement"])
    assert np.abs(grids[0]).max() > 0.01
    assert is_close(grids[1], grids[0], 1e-8)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_true_and_nominal_pressure_with_finite_kinematics(cell, tmp_path):
    """The true pressure is the nominal one divided by the area stretch of Γc, to 1e-12."""
    folder = shared_folder(tmp_path)
    setup = DiscOnRubber(cell)
    writer = fc.Writer(folder, setup.problem, stress=setup.scene.body.stress)
    for step in setup.increments(1.0, steps=2):
        writer.write(step)
    points = vtu.read_vtu(folder / "contact_points_0001.vtu").at_nodes
    contact = setup.contact
    stretch = np.concatenate(COMM.allgather(contact.area_stretch()))
    pressure = np.concatenate(COMM.allgather(contact.pressure))
    closed = pressure > 0
    assert np.abs(stretch[closed] - 1).max() > 1e-3  # otherwise the pressures would not differ
    ratio = np.sort((points["true_pressure"] / np.maximum(points["pressure"], 1e-9))[:, 0])
    expected = np.sort(np.where(closed, 1 / stretch, 0.0))
    assert is_close(ratio, expected, 1e-12)
    body = vtu.read_vtu(folder / "body_0001.vtu").at_nodes
    assert body["von_mises"].min() >= 0 and body["von_mises"].max() > 0


def test_stress_on_the_axis_of_symmetry(tmp_path):
    """Where u_r/r is 0/0 the stress is extrapolated from points inside the cells, to 1e-10."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBall(degree=2)
    body = fc.elasticity.LinearElastic(setup.scene.u, 1000.0, 0.3, "axisymmetric")
    setup.scene.u.interpolate(lambda x: np.vstack([1e-3 * x[0], 0 * x[0]]))
    fc.Writer(folder, setup.problem, stress=body.stress).write(0)
    grid = vtu.read_vtu(folder / "body_0000.vtu")
    assert np.any(grid.x[..., 0] == 0)
    lame, shear = 1000 * 0.3 / 1.3 / 0.4, 1000 / 2.6
    exact = np.diag([lame * 2e-3 + 2e-3 * shear, lame * 2e-3, lame * 2e-3 + 2e-3 * shear])
    assert is_close(grid.at_nodes["stress"], np.tile(exact.ravel(), (*grid.x.shape[:2], 1)), 1e-10)


def test_mixed_function_writes_its_displacement(tmp_path):
    """The displacement of the mixed function is written, equal on the body and on Γc to 1e-12."""
    folder = shared_folder(tmp_path)
    setup = DiscOnRubber(mixed="Taylor-Hood", nu=0.5, law=fc.Frictionless(1e4))
    writer = fc.Writer(folder, setup.problem, stress=setup.scene.body.stress)
    for step in setup.increments(0.5, steps=1):
        writer.write(step)
    body, top = (vtu.read_vtu(folder / f"{n}_0000.vtu") for n in ("body", "contact"))
    places = {tuple(x): u for x, u in zip(*flat(body), strict=True)}
    assert len(top.x) and all(
        np.allclose(places[tuple(x)], u, atol=1e-12) for x, u in zip(*flat(top), strict=True)
    )
    assert np.abs(top.at_nodes["displacement"]).max() > 0.01
    assert ufl.as_ufl(setup.scene.displacement).ufl_shape == (2,)


def flat(grid):
    return grid.x.reshape(-1, 3).round(9), grid.at_nodes["displacement"].reshape(-1, 3)
