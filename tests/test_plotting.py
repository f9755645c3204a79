"""Tests of pictures, without a screen, by the contents of the figures that are saved."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import plotting
from fenics_contact.results import drawing
from scenes.block_on_ball import BlockOnBall
from scenes.blocks import CELLS, dimension
from scenes.comparison import (
    assert_raised_on_all_ranks,
    check_on_first_rank,
    is_close,
    shared_folder,
)

matplotlib = pytest.importorskip("matplotlib")
COMM = MPI.COMM_WORLD

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

CORNERS = {"triangle": 3, "quadrilateral": 4, "tetrahedron": 3, "hexahedron": 4}


@pytest.fixture
def saved_figures(monkeypatch):
    """Return the list of saved figures, which remain open."""
    figures, save = [], drawing.save

    def record_figure(figure, path):
        figures.append(figure)
        save(figure, path)

    monkeypatch.setattr(drawing, "save", record_figure)
    return figures


@pytest.mark.parametrize("cell", CELLS)
def test_pictures_of_pressure_status_and_deformation(cell, tmp_path, saved_figures):
    """Every facet is drawn once on any number of ranks, at its place and in its colour.

    Axes have units, and displacements are magnified.
    """
    folder, d = shared_folder(tmp_path), dimension(cell)
    setup = BlockOnBall(cell=cell, mesh={"n": 4})
    setup.problem.small_displacement_tolerance = np.inf
    (step,) = fc.increments(setup.problem, setup.load, 0, 2, steps=1)
    plotting.plot_pressure(folder / "p.png", setup.contact, length="m", stress="Pa", title="Title")
    plotting.plot_status(folder / "s.png", setup.contact, length="m")
    plotting.plot_deformation(folder / "d.png", setup.scene.u, unit="m", magnification=2.0)
    points = setup.contact.gather()
    n_facets = {2: 4, 3: 16}[d] * (2 if cell == "tetrahedron" else 1)
    n_shapes = {"triangle": 32, "quadrilateral": 16, "tetrahedron": 192, "hexahedron": 96}[cell]

    def check():
        assert len(saved_figures) == 3
        pressure, status, deformed = saved_figures
        for figure in saved_figures:
            axes = figure.axes[0]
            assert axes.get_xlabel() == "x [m]" and axes.get_ylabel() == "y [m]"
        assert pressure.axes[1].get_ylabel() == "contact pressure [Pa]"
        assert pressure.axes[0].get_title() == "Title"
        body, *_, surface = pressure.axes[0].collections  # the obstacle in between in the plane
        assert len(shapes(body)) == n_shapes and len(shapes(surface)) == n_facets
        # The colour scale ends at the largest mean, and all loaded facets are coloured.
        by_facet = per_facet(points, cell)
        assert is_close(pressure.axes[1].get_ylim(), [0.0, by_facet.max()], 1e-12)
        colours = surface.get_facecolor() if d == 3 else surface.get_color()
        grey = matplotlib.colors.to_rgba("#d8d8d8")
        is_loaded = ~np.all(np.isclose(np.asarray(colours), grey), axis=1)
        assert np.count_nonzero(is_loaded) == np.count_nonzero(by_facet > 0)
        names = [text.get_text() for text in status.legends[0].get_texts()]
        assert names == ["open", "sticking", "slipping", *["rigid obstacle"] * (d == 2)]
        # Displacements are magnified by 2: the top moves by 0.1 along x and 0.03 down.
        before, after = (np.concatenate(shapes(c)) for c in deformed.axes[0].collections)
        assert is_close(before.max(axis=0)[: d - 1], np.ones(d - 1), 1e-12)
        assert is_close([after[:, 0].max()], [1.2], 1e-9)
        assert is_close([after[:, -1].max()], [1 - 0.06], 1e-9)
        outline = shapes(deformed.axes[0].collections[0])
        if d == 2:
            assert len(outline[0]) in (CORNERS[cell], CORNERS[cell] + 1)
        else:  # the twelve edges of the cube, each of four segments
            assert len(outline) == 48 and all(len(ends) == 2 for ends in outline)
        for name in ("p.png", "s.png", "d.png"):
            assert (folder / name).read_bytes()[:4] == b"\x89PNG"

    assert step.contacts["contact"].normal_force > 0
    check_on_first_rank(check)


@pytest.mark.parametrize("cell", CELLS)
def test_pictures_of_fields_and_stress(cell, tmp_path, saved_figures):
    """Facet means and point values agree with `gather`, von Mises stresses with a closed form.

    The stress is E ε along x, where the strain ε is proportional to x.
    """
    folder, d = shared_folder(tmp_path), dimension(cell)
    setup = BlockOnBall(cell=cell, mesh={"n": 4})
    setup.problem.small_displacement_tolerance = np.inf
    list(fc.increments(setup.problem, setup.load, 0, 2, steps=2))
    fields = ("pressure", "friction", "gap", "slip")
    for field in fields:
        plotting.plot_field(folder / f"{field}.png", setup.contact, field)
    if d == 2:
        plotting.plot_along(folder / "along.png", setup.contact)
    else:
        assert_raised_on_all_ranks(
            lambda: plotting.plot_along(folder / "a.png", setup.contact), ValueError, "plot_field"
        )
    assert_raised_on_all_ranks(
        lambda: plotting.plot_field(folder / "a.png", setup.contact, "heat"), ValueError, "'heat'"
    )
    points = setup.contact.gather()
    points["friction"] = np.linalg.norm(points["tangential_traction"], axis=1)
    u = fem.Function(fem.functionspace(setup.scene.mesh, ("Lagrange", 2, (d,))))
    u.interpolate(lambda x: np.vstack([0.05 * x[0] ** 2, *(0 * x[1:d])]))
    zero = 0.0 * u[0]
    rows = [[1000 * u[0].dx(0), zero, zero], [zero, zero, zero], [zero, zero, zero]]
    plotting.plot_deformation(folder / "u.png", u, stress=ufl.as_tensor(rows))
    tensor = ufl.as_tensor(rows)[0, 0]
    assert_raised_on_all_ranks(
        lambda: plotting.plot_deformation(folder / "a.png", u, stress=tensor), ValueError, "(3, 3)"
    )

    def check():
        for field, figure in zip(fields, saved_figures, strict=False):
            means = per_facet(points | {"pressure": points[field]}, cell)
            ends = [min(0.0, means.min()), max(0.0, means.max())]
            assert is_close(figure.axes[1].get_ylim(), ends, 1e-12), field
            grey = field != "gap" and bool(np.any(means == 0.0))
            assert legend_texts(figure)[d == 2 :] == ([f"no {field}"] if grey else [])
        if d == 2:
            lines = [line for axes in saved_figures[4].axes for line in axes.lines]
            curves = {line.get_label(): line.get_data() for line in lines}
            names = {"pressure": "pressure", "|tangential traction|": "friction", "gap": "gap"}
            for label, name in (names | {"accumulated slip": "slip"}).items():
                x, y = curves[label]
                assert len(x) > 2 and x.min() >= 0 and x.max() <= 1
                near = (points["x"][:, 0] >= x.min()) & (points["x"][:, 0] <= x.max())
                assert np.array_equal(np.sort(y), np.sort(points[name][near]))
        # The colour scale ends at the stress in the midpoints of the last cells along x.
        body = saved_figures[-1].axes[0].collections[1]
        largest = {"triangle": 11 / 12, "tetrahedron": 15 / 16}.get(cell, 7 / 8)
        assert is_close(saved_figures[-1].axes[1].get_ylim(), [0, 100 * largest], 1e-9)
        assert len(np.unique(np.asarray(body.get_facecolor()), axis=0)) >= 4

    check_on_first_rank(check)


def legend_texts(figure):
    """Return the texts in the legends of a figure."""
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def shapes(collection):
    """Return the corners of each shape of a collection, in the order given."""
    if hasattr(collection, "_segments3d"):
        return [np.asarray(ends) for ends in collection._segments3d]
    if hasattr(collection, "_faces"):  # in space; some releases have both
        return [np.asarray(face) for face in collection._faces]
    if hasattr(collection, "_vec"):  # rows x, y, z, 1 of all corners one after another
        return [collection._vec[:3, s].T for s in collection._segslices]
    return [path.vertices for path in collection.get_paths()]


def per_facet(points, cell):
    """Return the mean pressure of each facet of a grid of four per side, halved into triangles."""
    x = points["x"][:, :-1]
    number = np.floor(4 * x).astype(int) @ [1, 4][: x.shape[1]]
    if cell == "tetrahedron":
        inside = 4 * x - np.floor(4 * x)
        number = 2 * number + (inside[:, 0] > inside[:, 1])
    sums = np.bincount(number, points["measure"] * points["pressure"])
    return sums / np.bincount(number, points["measure"])


def test_missing_folder_is_refused(tmp_path):
    """All ranks raise the error of the first rank, without a picture."""
    setup = BlockOnBall()
    path = shared_folder(tmp_path) / "no" / "p.png"
    for call in (
        lambda: plotting.plot_pressure(path, setup.contact),
        lambda: plotting.plot_deformation(path, setup.scene.u),
    ):
        assert_raised_on_all_ranks(call, OSError, "no")


def test_wrong_displacements_are_refused(tmp_path):
    """The error is raised by the package, not by DOLFINx."""
    u = BlockOnBall().scene.u
    scalar = fem.Function(fem.functionspace(u.function_space.mesh, ("Lagrange", 1)))
    path = shared_folder(tmp_path) / "u.png"
    assert_raised_on_all_ranks(
        lambda: plotting.plot_deformation(path, scalar), ValueError, "shape ()", "contact.u"
    )
    assert_raised_on_all_ranks(
        lambda: plotting.plot_deformation(path, "u"), ValueError, "u is a str"
    )


@pytest.mark.parametrize("cell", CELLS)
def test_near_restricts_pictures_to_the_contact(cell, tmp_path, saved_figures):
    """All loaded facets are drawn, and nothing beyond ``near`` of them, unless it is None."""
    folder, d = shared_folder(tmp_path), dimension(cell)
    setup = BlockOnBall(cell=cell, mesh={"n": 8 if d == 2 else 4})
    setup.problem.small_displacement_tolerance = np.inf
    list(fc.increments(setup.problem, setup.load, 0, 1, steps=1))
    points = setup.contact.gather()
    reach, count = 0.05, np.count_nonzero(per_facet(points, cell) > 0)
    for near in (reach, None):
        plotting.plot_pressure(folder / "p.png", setup.contact, near=near)
        plotting.plot_status(folder / "s.png", setup.contact, near=near)
    for near in (0.0, -1.0, np.nan, "near"):
        assert_raised_on_all_ranks(
            lambda near=near: plotting.plot_status(folder / "a.png", setup.contact, near=near),
            ValueError,
            "length greater than zero",
        )

    def check():
        close_up, _, full_view, _ = saved_figures
        (some, all_shapes) = (
            shapes(figure.axes[0].collections[-1]) for figure in (close_up, full_view)
        )
        assert count <= len(some) < len(all_shapes)
        assert legend_texts(full_view)[d == 2 :] == ["no pressure"]
        for figure in saved_figures[:2]:
            body, *_, surface = figure.axes[0].collections
            bearing = np.concatenate(shapes(surface))
            n = CORNERS[cell]  # a closed path repeats the first
            middles = np.array([np.mean(shape[:n], axis=0) for shape in shapes(body)])
            middles = middles.reshape(-1, d)
            low, high = bearing.min(axis=0) - reach, bearing.max(axis=0) + reach
            assert np.all((middles >= low - 1e-12) & (middles <= high + 1e-12))

    check_on_first_rank(check)
