"""Rigid obstacles are drawn at the surface that defines them, displaced as they are.

References: the surfaces' equations. Linear interpolation on a grid of 1/160 of the box deviates
from a circle by h²/8R, less than 1e-4 of the box here, and from planes by round-off.
"""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.results import drawing
from fenics_contact.results.obstacles import ObstacleShape, zero_level
from scenes import vtu
from scenes.block_on_ball import BlockOnBall
from scenes.blocks import block, parabolic_floor
from scenes.comparison import check_on_first_rank, is_close, shared_folder
from scenes.rubber import DiscOnRubber

COMM = MPI.COMM_WORLD
FINE = 1e-4

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


def circle(centre, radius):
    return lambda x: np.linalg.norm(x - centre, axis=1) - radius


def obstacles(mesh):
    """Return, by name, obstacles and the equations of their displaced surfaces."""
    displacement, angle = fem.Constant(mesh, (0.1, 0.2)), fem.Constant(mesh, 0.0)
    points = np.array([[0.2, 0.2], [0.8, 0.2], [0.5, 0.7]])
    corners = np.array([[0, 1], [1, 2], [2, 0]])

    def triangle(x):
        ends = points[corners]
        edges = ends[:, 1] - ends[:, 0]
        along = np.einsum("pfi,fi->pf", x[:, None] - ends[:, 0], edges)
        fraction = np.clip(along / np.sum(edges**2, axis=1), 0, 1)
        off = x[:, None] - ends[:, 0] - fraction[:, :, None] * edges
        return np.linalg.norm(off, axis=2).min(axis=1)

    t = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    round_ = 0.5 + 0.3 * np.column_stack([np.cos(t), np.sin(t)])
    return {
        "plane": (fc.HalfSpace((0, 0.3), (1, 2)), lambda x: (x - [0, 0.3]) @ [1, 2] / 5**0.5),
        "moved": (fc.Ball((0.4, 0.3), 0.3, displacement=displacement), circle((0.5, 0.5), 0.3)),
        "hole": (fc.Cylinder((0.5, 0.5), 0.3, inside=True), circle((0.5, 0.5), 0.3)),
        "distance": (
            fc.SignedDistance(lambda x: ufl.sqrt(ufl.dot(x, x)) - displacement[1] * 3),
            circle((0, 0), 0.6),
        ),
        "spline": (fc.RigidProfile(round_, closed=True), circle((0.5, 0.5), 0.3)),
        "polyline": (fc.RigidSurface(points, corners), triangle),
        "turned": (
            fc.HalfSpace((0, 0.5), (0, 1), rotation=fc.Rotation(angle, (0.5, 0.5))),
            lambda x: (x - 0.5) @ [1, 0],
        ),
        "_angle": (angle, None),
    }


@pytest.mark.each
@pytest.mark.parametrize(
    "name", ["plane", "moved", "hole", "distance", "spline", "polyline", "turned"]
)
def test_drawn_surface_in_the_plane(name):
    """All drawn points are on the surface, whose length in the box is known from a finer grid."""
    scene = block("triangle")
    obstacle_list = obstacles(scene.mesh)
    obstacle, equation = obstacle_list[name]
    kinematics = "finite" if name == "turned" else "small"
    contact = scene.contact(fc.Frictionless(1e3), obstacle=obstacle, kinematics=kinematics)
    if name == "turned":
        obstacle_list["_angle"][0].value = -np.pi / 2

    def check():
        assert ObstacleShape.is_known(contact)
        drawn = ObstacleShape(contact)(np.array([[0.0, 0.0], [1.0, 1.0]]))
        assert len(drawn) > 20 and drawn.shape[1:] == (2, 2)
        # The corners of a polyline are cut off by up to a cell of the grid.
        allowed = 1 / 160 if name == "polyline" else FINE
        assert np.abs(equation(drawn.reshape(-1, 2))).max() < allowed
        axis = np.linspace(0, 1, 401)
        grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        if name != "polyline":  # its equation here has no sign
            values = equation(grid.reshape(-1, 2)).reshape(grid.shape[:2])
            lengths = [
                np.linalg.norm(s[:, 1] - s[:, 0], axis=1).sum()
                for s in (drawn, zero_level(grid, values))
            ]
            assert is_close(lengths[0], lengths[1], 1e-2)

    check_on_first_rank(check)


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_drawn_surface_in_space(cell):
    """The part of a ball in the box has the area 2π R h of a cap of height h, to 1 %."""
    setup = BlockOnBall(cell=cell)

    def check():
        box = np.array([[-2.5, -2.5, -1.0], [3.5, 3.5, 5.0]])
        drawn = ObstacleShape(setup.contact)(box)
        middle = np.array([0.5, 0.5, -2.0])
        assert np.abs(np.linalg.norm(drawn.reshape(-1, 3) - middle, axis=1) - 2.0).max() < 1e-2
        edges = drawn[:, 1:] - drawn[:, :1]
        area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2
        assert is_close(area, 2 * np.pi * 2.0 * 1.0, 1e-2)

    check_on_first_rank(check)


def test_prescribed_gap_is_not_drawn():
    """A gap prescribed on Γc, by a function or a number, has no known shape."""
    scene = block("triangle")
    for options in (
        {"obstacle": parabolic_floor(scene)},
        {"obstacle": fc.PrescribedGap(0.1, (0.0, -1.0))},
        {"gap": 0.1},
    ):
        assert not ObstacleShape.is_known(scene.contact(fc.Frictionless(1e3), **options))


def test_magnified_displacement_and_previous_states():
    """Displacements of obstacles are magnified; frames use the displacements of their own state."""
    scene = block("triangle")
    displacement = fem.Constant(scene.mesh, (0.0, -0.01))
    contact = scene.contact(fc.Frictionless(1e3), displacement=displacement)

    def check():
        shape, box = ObstacleShape(contact), np.array([[0.0, -1.0], [1.0, 1.0]])
        before = shape.state()
        displacement.value[1] = -0.02
        for state, depth in ((None, -0.4), (before, -0.2)):
            drawn = shape(box, 20.0, state)[..., 1]
            assert len(drawn) and np.abs(drawn - depth).max() < 1e-12

    check_on_first_rank(check)


def test_obstacle_in_pictures_animations_and_files(tmp_path, monkeypatch):
    """A tool moves down on rubber: all outputs show it at its position at the time."""
    folder = shared_folder(tmp_path)
    setup = DiscOnRubber(law=fc.Frictionless(1e4))
    figures, save = [], drawing.save
    monkeypatch.setattr(drawing, "save", lambda f, path: (figures.append(f), save(f, path)))
    writer = fc.Writer(folder / "files", setup.problem)
    film = fc.Animation(folder / "film.gif", setup.problem)
    for step in setup.increments(1.0, steps=2):
        writer.write(step)
        film.add(step)
    film.save()
    fc.plotting.plot_deformation(folder / "u.png", setup.contact.u, contacts=[setup.contact])
    fc.plotting.plot_status(folder / "status.png", setup.contact)
    COMM.barrier()

    def check():
        for figure in figures:
            words = [t.get_text() for legend in figure.legends for t in legend.get_texts()]
            assert "rigid obstacle" in words
        colour = drawing.COLOURS["obstacle"]
        drawn = [c for f in figures for c in f.axes[0].collections if is_of(c, colour)]
        assert len(drawn) == 2
        series = vtu.read_collection(folder / "files" / "contact_obstacle.pvd")
        assert len(series) == 2
        grids = [vtu.read_vtu(folder / "files" / name) for _, name in series]
        assert all(grid.kind == 3 and len(grid.x) > 20 for grid in grids)
        # It has moved down.
        assert grids[1].x[..., 1].min() < grids[0].x[..., 1].min() - 1e-3

    check_on_first_rank(check)


def is_of(collection, colour):
    """Return whether the lines of a collection have a colour."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba

    if not isinstance(collection, LineCollection):
        return False
    return bool(np.allclose(collection.get_color(), to_rgba(colour)))
