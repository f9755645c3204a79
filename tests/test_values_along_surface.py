"""Values along Γc in two dimensions contain every point once, in the order along Γc.

Reference: the positions of the points. Angles and arc lengths agree to 1e-9 of the largest, for
round-off; curved facets are measured along their chord.
"""

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.results import drawing
from fenics_contact.results.along import along
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block_mesh
from scenes.comparison import check_on_first_rank, is_close, shared_folder
from scenes.elasticity import displacement_space
from scenes.meshes import create_mesh
from scenes.tags import tag_by_nodes

COMM = MPI.COMM_WORLD
MIDDLE, INNER, OUTER = np.array([0.3, -0.2]), 1, 2
N = 24

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


def ring(oval=1.0):
    """Return a ring of quadrilaterals between the radii 1 and 2, stretched along x."""
    angle = np.linspace(0, 2 * np.pi, N, endpoint=False)
    circle = np.column_stack([oval * np.cos(angle), np.sin(angle)])
    x = MIDDLE + np.concatenate([(1 + 0.5 * i) * circle for i in range(3)])
    corner = np.arange(2 * N)
    next_corner = (corner + 1) % N + corner // N * N
    mesh = create_mesh(
        "quadrilateral", x, np.stack([corner, next_corner, corner + N, next_corner + N], axis=1)
    )

    def radius(x):
        arm = x[:2] - MIDDLE[:, None]
        return np.hypot(arm[0] / oval, arm[1])

    return mesh, tag_by_nodes(
        mesh, {t: lambda x, t=t: np.isclose(radius(x), float(t)) for t in (INNER, OUTER)}
    )


def pin(direction=(0.0, -1.0)):
    """Return a pin that is in contact with about a quarter of the hole."""
    return fc.Ball(MIDDLE + 0.1 * np.asarray(direction), 0.92)


def evaluated_contact(mesh, tags, which, obstacle):
    """Return a contact, evaluated for the undeformed body."""
    u = fem.Function(displacement_space(mesh, 1))
    surface = fc.ContactSurface(mesh, tags, which)
    contact = fc.Contact(u, surface, obstacle, fc.Frictionless(1e3))
    contact.evaluate()
    return contact


def check(contact, computed, n_curves):
    """Assert that every point occurs once with its values, and that each curve is monotonic."""
    points = contact.gather()

    def compare():
        order = np.lexsort(np.round(computed.values["x"], 9).T[::-1])
        for name in ("x", "pressure", "gap", "status"):
            assert is_close(computed.values[name][order], points[name], 1e-12), name
        assert len(computed.curves) == n_curves
        assert np.sum(computed.curves, axis=0).max() == 1
        for curve in computed.curves:
            steps = np.diff(computed.abscissa[curve])
            assert np.all(steps > 0) or np.all(steps < 0)

    check_on_first_rank(compare)


@pytest.mark.parametrize("direction", [(0.0, -1.0), (-1.0, 0.0), (0.6, 0.8)])
def test_circular_hole_is_plotted_over_the_angle(direction):
    """The angle is exact, and the pressure has a single maximum, at every side of the hole."""
    mesh, tags = ring()
    contact = evaluated_contact(mesh, tags, INNER, pin(direction))
    computed = along(contact)
    check(contact, computed, 1)

    def compare():
        assert (
            computed.is_angle and computed.label == "angle about (0.3, -0.2), from the x axis [°]"
        )
        arm = computed.values["x"] - MIDDLE
        deviation = np.exp(1j * np.radians(computed.abscissa)) - (arm @ [1, 1j]) / np.hypot(*arm.T)
        assert np.abs(deviation).max() < 1e-9
        is_loaded = computed.values["pressure"][computed.curves[0]] > 0
        facets = np.any(is_loaded.reshape(-1, 2), axis=1) if len(is_loaded) % 2 == 0 else is_loaded
        assert 0 < is_loaded.sum() and np.count_nonzero(np.diff(facets.astype(int))) == 2
        middle = computed.abscissa[computed.values["pressure"].argmax()]
        towards = np.degrees(np.arctan2(direction[1], direction[0]))
        assert abs((middle - towards + 180) % 360 - 180) < 360 / N
        assert -180 <= (computed.abscissa.min() + computed.abscissa.max()) / 2 <= 180

    check_on_first_rank(compare)


def test_both_surfaces_of_a_ring_give_two_curves():
    """Inner and outer surface are two curves over the angle about one centre."""
    mesh, tags = ring()
    contact = evaluated_contact(mesh, tags, [INNER, OUTER], fc.Ball(MIDDLE, 1.5, inside=True))
    computed = along(contact)
    check(contact, computed, 2)
    check_on_first_rank(lambda: np.testing.assert_equal(computed.is_angle, True))


def test_oval_hole_is_plotted_over_the_arc_length():
    """The arc length ends at the length of all facets, and increases by chords of facets."""
    mesh, tags = ring(oval=1.5)
    contact = evaluated_contact(mesh, tags, INNER, fc.Ball(MIDDLE - [0, 0.1], 0.95))
    computed = along(contact, "m")
    check(contact, computed, 1)
    length = COMM.allreduce(contact.quadrature.weights.sum())

    def compare():
        assert not computed.is_angle and "arc length" in computed.label and "[m]" in computed.label
        assert 0 < computed.abscissa.min() and computed.abscissa.max() < length
        # The distance of the points of a facet is that along their chord.
        x, s = (v.reshape(N, -1, *v.shape[1:]) for v in (computed.values["x"], computed.abscissa))
        chord = np.linalg.norm(x[:, -1] - x[:, 0], axis=1)
        assert is_close(s[:, -1] - s[:, 0], chord, 1e-9)
        assert is_close(length, chord.sum() * np.sqrt(3), 1e-9)  # chord between the Gauss points

    check_on_first_rank(compare)


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
def test_abscissa_of_the_sides_of_a_block(which, label, n_curves):
    """The abscissa is a coordinate if it is monotonic along Γc, otherwise the arc length."""
    mesh, tags = block_mesh("triangle", n=4)
    obstacle = fc.Ball((0.5, 0.5), 0.505, inside=True)  # in contact at all corners, none cut off
    contact = evaluated_contact(mesh, tags, which, obstacle)
    computed = along(contact)
    check(contact, computed, n_curves)
    check_on_first_rank(lambda: np.testing.assert_equal(computed.label.startswith(label), True))


def test_plot_shows_the_curves(tmp_path, monkeypatch):
    """The plot contains exactly these curves, without a line across the hole."""
    figures, save = [], drawing.save
    monkeypatch.setattr(drawing, "save", lambda f, path: (figures.append(f), save(f, path)))
    mesh, tags = ring()
    contact = evaluated_contact(mesh, tags, INNER, pin())
    fc.plotting.plot_along(shared_folder(tmp_path) / "along.png", contact)
    computed = along(contact)

    def compare():
        (upper, lower) = figures[0].axes
        (curve,) = computed.curves
        for axes, name in ((upper, "pressure"), (lower, "gap")):
            x, y = axes.lines[0].get_data()
            assert np.array_equal(x, computed.abscissa[curve])
            assert np.array_equal(y, computed.values[name][curve])
        assert lower.get_xlabel() == computed.label

    check_on_first_rank(compare)
