"""Rigid obstacles from data: their distance and its derivatives."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial import ConvexHull

import fenics_contact as fc
from scenes.comparison import assert_raised_on_all_ranks, is_close, shared_folder
from scenes.rubber import rubber
from scenes.surfaces import ball, box, circle, ring, write_stl

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD
RNG = np.random.default_rng(3)


@pytest.fixture(autouse=True)
def same_numbers():
    """Start every test with the same random numbers, on every rank."""
    RNG.bit_generator.state = np.random.default_rng(3).bit_generator.state


# ---- surfaces ------------------------------------------------------------------------------------


def star(n=9):
    """Return a closed polyline with convex and concave corners."""
    points = circle(2 * n) * np.where(np.arange(2 * n) % 2, 0.45, 1.0)[:, None]
    return points, ring(2 * n)


def stone(n=60):
    """Return a convex body with random corners and triangles of all shapes."""
    points = RNG.normal(size=(n, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    points *= [1.0, 0.7, 0.5]
    facets = ConvexHull(points).simplices.copy()
    a, b, c = (points[facets[:, i]] for i in range(3))
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) < 0
    facets[inwards] = facets[inwards][:, ::-1]
    return points, facets


def bowl():
    """Return a box with a pit: concave edges and corners, where facets occlude each other."""
    points, facets = box((-1, -1, -1), (1, 1, 1))
    inner, hole = box((-0.5, -0.6, -0.4), (0.6, 0.5, 1))
    sides = [i for i, f in enumerate(facets) if set(f) != {4, 5, 7} and set(f) != {4, 7, 6}]
    walls = 8 + hole[sides][:, ::-1]
    rim = []
    for a, b in ((4, 5), (5, 7), (7, 6), (6, 4)):
        rim += [(a, b, 8 + b), (a, 8 + b, 8 + a)]
    return np.concatenate([points, inner]), np.concatenate([facets[sides], walls, rim])


def needles(n=40):
    """Return a closed cylinder of long thin triangles with an oblique axis."""
    low = np.column_stack([circle(n, 0.4), np.full(n, -1.0)])
    points = np.concatenate([low, low * [1, 1, -1], [[0, 0, -1], [0, 0, 1]]])
    i, j = ring(n).T
    caps = [
        np.column_stack([j, i, 0 * i + 2 * n]),
        np.column_stack([i + n, j + n, 0 * i + 2 * n + 1]),
    ]
    sides = [np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])]
    slant = np.linalg.qr(np.array([[1.0, 0.3, 0.2], [0, 1, 0.4], [0.5, 0, 1]]))[0]
    return points @ (slant * np.sign(np.linalg.det(slant))).T, np.concatenate([*caps, *sides])


SURFACES = {"star": star, "stone": stone, "bowl": bowl, "needles": needles}


def brute_distance(points, facets, x):
    """Return the least distance from all facets, to projections on planes, edges and corners."""
    corners = points[facets]
    least = np.full(len(x), np.inf)
    for corner in corners:
        n = len(corner)
        subsets = [[i] for i in range(n)] + [[i, (i + 1) % n] for i in range(n)]
        subsets += [list(range(n))] if n == 3 else []
        for subset in subsets:
            base, *others = corner[subset]
            span = np.array(others).reshape(len(others), x.shape[1]) - base
            coordinates = (x - base) @ np.linalg.pinv(span) if others else np.zeros((len(x), 0))
            within = np.all(coordinates >= 0, axis=1) & (coordinates.sum(axis=1) <= 1)
            away = np.linalg.norm(x - base - coordinates @ span, axis=1)
            least = np.where(within, np.minimum(least, away), least)
    return least


def winding(points, facets, x):
    """Return the winding number at points: by angles, or solid angles (van Oosterom, Strackee)."""
    arms = points[facets][None] - x[:, None, None, :]
    if x.shape[1] == 2:
        a, b = arms[:, :, 0], arms[:, :, 1]
        cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        return np.arctan2(cross, np.sum(a * b, axis=2)).sum(axis=1) / (2 * np.pi)
    a, b, c = (arms[:, :, i] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    dots = (np.sum(p * q, axis=2) for p, q in ((a, b), (b, c), (c, a)))
    ab, bc, ca = dots
    volume = np.sum(a * np.cross(b, c), axis=2)
    return (2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)).sum(1) / (4 * np.pi)


def sample_points(points, n=600):
    """Return points near and far, inside and outside, and close to corners."""
    d = points.shape[1]
    wide = RNG.uniform(-1.6, 1.6, size=(n, d))
    near = points[RNG.integers(len(points), size=n)] + 0.02 * RNG.normal(size=(n, d))
    return np.concatenate([wide, near])


@pytest.mark.each
@pytest.mark.parametrize("name", SURFACES)
def test_signed_distance_of_a_surface(name):
    """Reference: the least distance from all facets, signed by the winding number; 1e-12."""
    points, facets = SURFACES[name]()
    surface, x = fc.RigidSurface(points, facets), sample_points(points)
    computed = surface.sample(x).distance
    inside = winding(points, facets, x)
    assert np.allclose(inside, np.round(inside), atol=1e-6)
    assert 50 < np.sum(inside > 0.5) < len(x) - 50
    signed = np.where(inside > 0.5, -1.0, 1.0) * brute_distance(points, facets, x)
    assert np.abs(computed - signed).max() < 1e-12
    assert surface.facets.closed


@pytest.mark.each
@pytest.mark.parametrize("name", [*SURFACES, "profile", "extruded", "turned"])
def test_normal_and_curvature_are_derivatives(name):
    """Reference: central differences with h = 1e-6 that stay on one facet, edge or corner.

    With the curvature 1/r their error is h²/r² and h²/r³, plus round-off divided by h, 1e-10.
    """
    if name in SURFACES:
        points, facets = SURFACES[name]()
        obstacle, x = fc.RigidSurface(points, facets), sample_points(points)
    else:
        obstacle, x = _wavy(name)
    d, step = x.shape[1], 1e-6
    sample = obstacle.sample(x)
    slope, bend = np.empty((len(x), d)), np.empty((len(x), d, d))
    size = 1 + np.abs(sample.curvature).max(axis=(1, 2))
    same = np.abs(sample.distance) > 1e-3
    for i, e in enumerate(np.eye(d)):
        ahead, behind = obstacle.sample(x + step * e), obstacle.sample(x - step * e)
        slope[:, i] = (ahead.distance - behind.distance) / (2 * step)
        bend[:, i] = -(ahead.normal - behind.normal) / (2 * step)
        for side in (ahead, behind):
            same &= np.abs(side.curvature - sample.curvature).max(axis=(1, 2)) < 0.01 * size
            same &= np.abs(side.normal - sample.normal).max(axis=1) < 2 * step * size
    assert np.abs(np.linalg.norm(sample.normal, axis=1) - 1).max() < 1e-12
    assert np.mean(same) > 0.95
    wrong = np.abs(slope + sample.normal).max(axis=1)
    assert np.all((wrong < 1e-8 + 3 * (step * size) ** 2)[same])
    wrong = np.abs(bend - sample.curvature).max(axis=(1, 2))
    assert np.all((wrong < 1e-8 * size + 10 * step**2 * size**3)[same])
    assert np.abs(sample.curvature - np.swapaxes(sample.curvature, 1, 2)).max() < 1e-12 * size.max()


def _wavy(name):
    """Return a wavy closed profile, or one extruded or turned in space, and points."""
    t = 2 * np.pi * np.arange(80) / 80
    flat = circle(80) * (1 + 0.1 * np.cos(3 * t))[:, None]
    if name == "profile":
        return fc.RigidProfile(flat, closed=True), RNG.uniform(0.6, 1.6, (400, 2)) * [1, -1]
    x = RNG.uniform(0.5, 1.5, (400, 3))
    if name == "extruded":
        points = np.column_stack([flat, RNG.normal(size=80)])
        return fc.RigidProfile(points, closed=True, extruded=(0, 0, 2)), x
    half = np.column_stack([flat[:, 0] + 2, 0 * t, flat[:, 1]])
    return fc.RigidProfile(half, closed=True, turned=((0, 0, 0), (0, 0, 1))), 1.5 * x


def test_normal_and_curvature_at_edges_and_corners():
    """On a box the normal is the pseudo-normal, and nearby points have the sign of their side."""
    points, facets = box((-1, -1, -1), (1, 1, 1))
    obstacle = fc.RigidSurface(points, facets)
    computed = obstacle.sample(points)
    assert np.abs(computed.distance).max() == 0.0
    assert is_close(computed.normal, -points / np.sqrt(3), 1e-12)
    middle = np.array([[1.0, 1.0, 0.2], [-1.0, 0.1, 1.0]])
    expected = -middle * [[1, 1, 0], [1, 0, 1]] / np.sqrt(2)
    assert is_close(obstacle.sample(middle).normal, expected, 1e-12)
    for side in (1.0, -1.0):
        x = points * (1 + side * 1e-4)
        assert np.all(np.sign(obstacle.sample(x).distance) == side)
    off = obstacle.sample(np.array([[1.3, 1.4, 0.2], [2.0, 3.0, 3.0]]))
    assert is_close(off.distance, [0.5, 3.0], 1e-12)
    # Around the edge, level sets are circles (radius 0.5); around the corner, spheres (radius 3).
    t = np.array([-0.8, 0.6, 0.0])
    assert is_close(off.curvature[0], np.outer(t, t) / 0.5, 1e-12)
    n = np.array([1.0, 2.0, 2.0]) / 3
    assert is_close(off.curvature[1], (np.eye(3) - np.outer(n, n)) / 3, 1e-12)


def test_points_beyond_the_border_of_an_open_surface_are_outside():
    """Points closest to the border are outside, above or below it; those behind a facet inside."""
    floor = fc.RigidSurface([[1.0, 0.0], [-1.0, 0.0]], [[0, 1]])  # the obstacle is below
    x = np.array([[0.2, 0.3], [0.2, -0.3], [1.3, 0.4], [1.3, -0.4], [-1.0 - 1e-6, -0.5]])
    assert not floor.facets.closed
    for obstacle in (floor, fc.RigidProfile([[1.0, 0.0], [0.3, 0.0], [-1.0, 0.0]])):
        computed = obstacle.sample(x)
        assert is_close(computed.distance, [0.3, -0.3, 0.5, 0.5, 0.5], 1e-9)
        assert is_close(computed.normal[:2], [[0, -1], [0, -1]], 1e-9)
        assert is_close(computed.normal[3], np.array([-0.6, 0.8]), 1e-9)


def test_distance_of_a_faceted_ball_converges():
    """When edges are halved, the error of the distance falls by a factor of four, within 3 to 5."""
    x = sample_points(ball(1)[0], 300)
    x = x[np.linalg.norm(x, axis=1) > 0.3]
    exact = np.linalg.norm(x, axis=1) - 1
    errors = [np.abs(fc.RigidSurface(*ball(n)).sample(x).distance - exact).max() for n in (2, 3, 4)]
    assert errors[2] < 4e-3
    assert all(3.0 < a / b < 5.0 for a, b in pairwise(errors))


def test_halvings_approach_a_smooth_surface():
    """With 16 times the facets, errors on a ball fall to 1/5 (distance) and 1/3 (normal).

    Distance errors on a cylinder of 40 needles and on its rim fall to 1/5; its caps, and a box,
    remain flat (1e-12).
    """
    x = sample_points(ball(1)[0], 300)
    x = x[np.linalg.norm(x, axis=1) > 0.3]
    length = np.linalg.norm(x, axis=1)
    errors = []
    for halvings in (0, 2):
        surface = fc.RigidSurface(*ball(3), halvings=halvings)
        computed = surface.sample(x)
        turn = np.abs(computed.normal + x / length[:, None]).max()
        errors.append((np.abs(computed.distance - length + 1).max(), turn))
        assert surface.facets.closed and len(surface.facets.facets) == 512 * 4**halvings
    assert errors[0][0] > 5 * errors[1][0] and errors[0][1] > 3 * errors[1][1]

    t, turned = RNG.uniform(0, 2 * np.pi, 200), needles()[0][-2:]
    axis = (turned[1] - turned[0]) / 2
    one = np.cross(axis, [1.0, 0, 0]) / np.linalg.norm(np.cross(axis, [1.0, 0, 0]))
    out = np.outer(np.cos(t), one) + np.outer(np.sin(t), np.cross(axis, one))
    y = 0.5 * out + np.outer(RNG.uniform(-0.3, 0.3, 200), axis)
    above = 2.0 * axis + 0.2 * out
    flat, bent = (fc.RigidSurface(*needles(), halvings=n) for n in (0, 2))
    wrong = [np.abs(s.sample(y).distance - 0.1).max() for s in (flat, bent)]
    assert wrong[0] > 1e-3 and wrong[1] < wrong[0] / 5
    wrong = [np.abs(s.sample(axis + 0.4 * out).distance).max() for s in (flat, bent)]
    assert wrong[0] > 1e-3 and wrong[1] < wrong[0] / 5
    assert bent.facets.closed
    assert is_close(bent.sample(above).distance, np.ones(200), 1e-12)

    points, facets = box((-1, -1, -1), (1, 1, 1))
    z = sample_points(points, 100)
    unsplit, parts = (fc.RigidSurface(points, facets, halvings=n).sample(z) for n in (0, 2))
    assert is_close(parts.distance, unsplit.distance, 1e-12)


def test_distant_points_and_no_points():
    """Distances up to 1e60, as of diverged iterates, are accurate to 1e-6; points may be empty."""
    x = RNG.normal(size=(2000, 3))
    x /= np.linalg.norm(x, axis=1)[:, None]
    surface = fc.RigidSurface(*ball(5))
    for away in (1e3, 1e8, 1e60):
        assert is_close(surface.sample(away * x).distance, away - np.ones(2000), 1e-6)
    # A point at the origin causes no division by zero.
    with np.errstate(all="raise"):
        assert fc.RigidSurface(*ball(1, 1e3)).sample(np.zeros((1, 3))).distance < 0
    nothing = surface.sample(np.empty((0, 3)))
    assert nothing.distance.shape == (0,) and nothing.curvature.shape == (0, 3, 3)
    flat = fc.RigidProfile(circle(40), closed=True).sample(np.empty((0, 2)))
    assert flat.distance.shape == (0,) and flat.curvature.shape == (0, 2, 2)


def test_many_points_and_facets():
    """Distances of 10,000 points from a ball of 131,072 triangles, to the height of its facets."""
    obstacle = fc.RigidSurface(*ball(7))
    x = RNG.normal(size=(10_000, 3))
    x *= (RNG.uniform(0.95, 1.1, size=10_000) / np.linalg.norm(x, axis=1))[:, None]
    computed = obstacle.sample(x)
    assert np.abs(computed.distance - np.linalg.norm(x, axis=1) + 1).max() < 1.1e-4


def test_spline_through_points_of_a_circle():
    """A spline with 200 points has distances of a circle to 1e-8, normals 1e-5, curvature 1e-3.

    So has its extrusion along an oblique axis, and half of it turned to a ball, on the axis too.
    """
    points, radius = circle(200, 0.8), 0.8
    axis = np.array([0.2, 1.0, 0.4]) / np.sqrt(1.2)
    one = np.cross(axis, [1, 0, 0]) / np.linalg.norm(np.cross(axis, [1, 0, 0]))
    plane = np.array([one, np.cross(axis, one)])
    t = np.linspace(-np.pi / 2, np.pi / 2, 101)
    half = radius * (np.outer(np.cos(t), one) + np.outer(np.sin(t), axis)) + 1
    x = RNG.uniform(-2, 2, (500, 3))
    x = np.concatenate([x, np.outer([-1.3, 0.5, 0.9, 1.2], axis)])
    for obstacle, place, matrix in (
        (fc.RigidProfile(points, closed=True), x @ plane.T, np.eye(2)),
        (fc.RigidProfile(points @ plane, closed=True, extruded=3 * axis), x, plane.T @ plane),
        (fc.RigidProfile(half, turned=((1, 1, 1), axis)), x + 1, np.eye(3)),
    ):
        arm = (place - (1 if obstacle.gdim == 3 and np.trace(matrix) > 2.5 else 0)) @ matrix
        length = np.linalg.norm(arm, axis=1)
        outside = length > 0.25
        computed, n = obstacle.sample(place[outside]), arm[outside] / length[outside, None]
        assert is_close(computed.distance, length[outside] - radius, 1e-8, scale=1.0)
        assert is_close(computed.normal, -n, 1e-5)
        bend = (matrix - np.einsum("ni,nj->nij", n, n)) / length[outside, None, None]
        assert is_close(computed.curvature, bend, 1e-3)


# ---- files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("binary", [True, False])
def test_stl_files(binary, tmp_path):
    """Binary files, though the header begins with "solid", and text files are read, and scaled."""
    folder = shared_folder(tmp_path)
    points, facets = ball(2)
    if COMM.rank == 0:
        write_stl(folder / "ball.stl", 1e3 * points, facets, binary=binary)
    COMM.barrier()
    read = fc.RigidSurface.from_stl(folder / "ball.stl", scale=1e-3)
    x = sample_points(points, 50)
    expected = fc.RigidSurface(points, facets).sample(x)
    # A binary file has single precision: relative round-off 6e-8.
    allowed = 1e-6 if binary else 1e-12
    assert read.facets.closed and len(read.facets.facets) == len(facets)
    assert is_close(read.sample(x).distance, expected.distance, allowed)
    if COMM.rank == 0:
        (folder / "none.stl").write_text("solid nothing\nendsolid nothing\n")
    COMM.barrier()
    make = lambda: fc.RigidSurface.from_stl(folder / "none.stl")  # noqa: E731
    assert_raised_on_all_ranks(make, ValueError, "holds no triangles")


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


@pytest.mark.whole
@pytest.mark.parametrize(
    ("make", "text"),
    [
        (
            lambda: fc.RigidSurface(SQUARE, [[0, 1, 2], [0, 3, 2]]),
            "at (0.5, 0.5, 0), neighbours have opposite orientations",
        ),
        (lambda: fc.RigidSurface(SQUARE[:, :2], [[0, 1], [2, 1]]), "at (1, 0), neighbours"),
        (lambda: fc.RigidSurface(SQUARE, [[0, 1, 4]]), "from 0 to 4"),
        (lambda: fc.RigidSurface(SQUARE, [[0, 1]]), "(n_facets, 3)"),
        (lambda: fc.RigidSurface(SQUARE, [[0.0, 1.0, 2.0]]), "must be integers"),
        (lambda: fc.RigidSurface([1.0, 2.0], [[0, 1]]), "(n, 2) in the plane"),
        (lambda: fc.RigidSurface([[0, 0], [np.nan, 0]], [[0, 1]]), "1 of the 2 are not finite"),
        (lambda: fc.RigidSurface(SQUARE[[0, 1, 1]], [[0, 1, 2]]), "no facet has an area"),
        (lambda: fc.RigidSurface.from_stl("none.stl", scale=0), "scale is 0"),
        (lambda: fc.RigidSurface(SQUARE, [[0, 1, 2]], halvings=0.5), "halvings of"),
        (lambda: fc.RigidSurface(SQUARE[:, :2], [[0, 1]], halvings=1), "use a RigidProfile"),
        (lambda: fc.RigidSurface(SQUARE, [[0, 1, 2]], sharp=0), "sharp is 0"),
        (lambda: fc.RigidProfile(SQUARE), "one of them with points in space"),
        (lambda: fc.RigidProfile(SQUARE[:, :2], extruded=(0, 0, 1)), "neither extruded nor turned"),
        (lambda: fc.RigidProfile(SQUARE[[0, 1, 1], :2]), "[1]"),
        (lambda: fc.RigidProfile(SQUARE, turned=(0, 0, 1)), "a point of the axis"),
        (lambda: fc.RigidProfile(SQUARE, extruded=(0, 0, 0)), "length zero"),
    ],
)
def test_bad_data_is_refused(make, text):
    """Bad data raise an error that states the value given and what is required."""
    with pytest.raises(ValueError, match=re.escape(text)):
        make()


def test_data_of_wrong_dimension_or_different_by_rank_are_refused():
    """A plane profile on a 3D mesh, and arrays that differ between ranks, raise an error."""
    scene = rubber("tetrahedron", 1, n=(2, 1))
    law = fc.Frictionless(1e3)
    flat = fc.RigidProfile(circle(9), closed=True)
    assert_raised_on_all_ranks(lambda: scene.contact(flat, law), ValueError, "2 dimensions")
    different_by_rank = fc.RigidSurface(*ball(1, 1.0 + COMM.rank))
    if COMM.size > 1:
        assert_raised_on_all_ranks(
            lambda: scene.contact(different_by_rank, law), ValueError, "differ between ranks"
        )
