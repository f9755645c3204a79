"""Values along Γc of plane bodies: every point once, in the order in which Γc has them.

References: the places of the points themselves; angles and arc lengths to 1e-9 of the largest, for
round-off, but where curved facets are measured along their chord.
"""

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.results import drawing
from fenics_contact.results.along import along
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block_mesh
from scenes.comparing import close, on_first, shared_folder
from scenes.elasticity import displacement_space
from scenes.meshes import mesh_of
from scenes.tags import sides

COMM = MPI.COMM_WORLD
MIDDLE, INNER, OUTER = np.array([0.3, -0.2]), 1, 2
N = 24

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


def ring(oval=1.0):
    """A ring of quadrilaterals between the radii 1 and 2, stretched along x."""
    angle = np.linspace(0, 2 * np.pi, N, endpoint=False)
    circle = np.column_stack([oval * np.cos(angle), np.sin(angle)])
    x = MIDDLE + np.concatenate([(1 + 0.5 * i) * circle for i in range(3)])
    corner = np.arange(2 * N)
    beside = (corner + 1) % N + corner // N * N
    mesh = mesh_of("quadrilateral", x, np.stack([corner, beside, corner + N, beside + N], axis=1))

    def radius(x):
        arm = x[:2] - MIDDLE[:, None]
        return np.hypot(arm[0] / oval, arm[1])

    return mesh, sides(
        mesh, {t: lambda x, t=t: np.isclose(radius(x), float(t)) for t in (INNER, OUTER)}
    )


def pin(direction=(0.0, -1.0)):
    """It is so far from the middle of the hole that about a quarter of it bears."""
    return fc.Ball(MIDDLE + 0.1 * np.asarray(direction), 0.92)


def evaluated(mesh, tags, which, obstacle):
    """A contact with the undeformed body, evaluated."""
    u = fem.Function(displacement_space(mesh, 1))
    surface = fc.ContactSurface(mesh, tags, which)
    contact = fc.Contact(u, surface, obstacle, fc.Frictionless(1e3))
    contact.evaluate()
    return contact


def check(contact, found, n_curves):
    """Every point is there once with its values, and each curve goes one way."""
    points = contact.gather()

    def compare():
        order = np.lexsort(np.round(found.values["x"], 9).T[::-1])
        for name in ("x", "pressure", "gap", "status"):
            assert close(found.values[name][order], points[name], 1e-12), name
        assert len(found.curves) == n_curves
        assert np.sum(found.curves, axis=0).max() == 1
        for curve in found.curves:
            steps = np.diff(found.abscissa[curve])
            assert np.all(steps > 0) or np.all(steps < 0)

    on_first(compare)


@pytest.mark.parametrize("direction", [(0.0, -1.0), (-1.0, 0.0), (0.6, 0.8)])
def test_a_hole(direction):
    """The angle about its middle; the pressure has one hump, whatever side the pin is on."""
    mesh, tags = ring()
    contact = evaluated(mesh, tags, INNER, pin(direction))
    found = along(contact)
    check(contact, found, 1)

    def compare():
        assert found.is_angle and found.label == "angle about (0.3, -0.2), from the x axis [°]"
        arm = found.values["x"] - MIDDLE
        way = np.exp(1j * np.radians(found.abscissa)) - (arm @ [1, 1j]) / np.hypot(*arm.T)
        assert np.abs(way).max() < 1e-9
        bears = found.values["pressure"][found.curves[0]] > 0
        facets = np.any(bears.reshape(-1, 2), axis=1) if len(bears) % 2 == 0 else bears
        assert 0 < bears.sum() and np.count_nonzero(np.diff(facets.astype(int))) == 2
        middle = found.abscissa[found.values["pressure"].argmax()]
        towards = np.degrees(np.arctan2(direction[1], direction[0]))
        assert abs((middle - towards + 180) % 360 - 180) < 360 / N
        assert -180 <= (found.abscissa.min() + found.abscissa.max()) / 2 <= 180

    on_first(compare)


def test_a_ring_with_both_its_surfaces():
    """Two curves about one middle, each a line of its own."""
    mesh, tags = ring()
    contact = evaluated(mesh, tags, [INNER, OUTER], fc.Ball(MIDDLE, 1.5, inside=True))
    found = along(contact)
    check(contact, found, 2)
    on_first(lambda: np.testing.assert_equal(found.is_angle, True))


def test_an_oval_hole():
    """The arc length: by its end that of all facets, and each point where it is on them."""
    mesh, tags = ring(oval=1.5)
    contact = evaluated(mesh, tags, INNER, fc.Ball(MIDDLE - [0, 0.1], 0.95))
    found = along(contact, "m")
    check(contact, found, 1)
    length = COMM.allreduce(contact.quadrature.weights.sum())

    def compare():
        assert not found.is_angle and "arc length" in found.label and "[m]" in found.label
        assert 0 < found.abscissa.min() and found.abscissa.max() < length
        # Points of one facet are as far apart as their chord.
        x, s = (v.reshape(N, -1, *v.shape[1:]) for v in (found.values["x"], found.abscissa))
        chord = np.linalg.norm(x[:, -1] - x[:, 0], axis=1)
        assert close(s[:, -1] - s[:, 0], chord, 1e-9)
        assert close(length, chord.sum() * np.sqrt(3), 1e-9)  # between the points of Gauss

    on_first(compare)


@pytest.mark.whole
@pytest.mark.parametrize(
    ("which", "label", "n_curves"),
    [
        (BOTTOM, "x [mm]", 1),
        (LEFT, "y [mm]", 1),
        ([BOTTOM, TOP], "x [mm]", 2),
        ([BOTTOM, RIGHT], "arc length along Γc, from (0, 0) [mm]", 1),
        ([BOTTOM, TOP, LEFT, RIGHT], "arc length along Γc", 1),
    ],
)
def test_sides_of_a_block(which, label, n_curves):
    """The coordinate where Γc does not turn back, else the arc length round its corners."""
    mesh, tags = block_mesh("triangle", n=4)
    obstacle = fc.Ball((0.5, 0.5), 0.505, inside=True)  # bears at the corners, none is cut off
    contact = evaluated(mesh, tags, which, obstacle)
    found = along(contact)
    check(contact, found, n_curves)
    on_first(lambda: np.testing.assert_equal(found.label.startswith(label), True))


def test_the_picture(tmp_path, monkeypatch):
    """What is drawn are these curves: no line from one side of the hole to the other."""
    figures, save = [], drawing.save
    monkeypatch.setattr(drawing, "save", lambda f, path: (figures.append(f), save(f, path)))
    mesh, tags = ring()
    contact = evaluated(mesh, tags, INNER, pin())
    fc.plotting.plot_along(shared_folder(tmp_path) / "along.png", contact)
    found = along(contact)

    def compare():
        (upper, lower) = figures[0].axes
        (curve,) = found.curves
        for axes, name in ((upper, "pressure"), (lower, "gap")):
            x, y = axes.lines[0].get_data()
            assert np.array_equal(x, found.abscissa[curve])
            assert np.array_equal(y, found.values[name][curve])
        assert lower.get_xlabel() == found.label

    on_first(compare)
