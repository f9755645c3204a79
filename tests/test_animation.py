"""Animations have correct frames, colours and axes, and are never left partly written."""

import gc

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.results import drawing
from scenes.block_on_ball import BlockOnBall
from scenes.blocks import dimension
from scenes.comparison import (
    assert_raised_on_all_ranks,
    check_on_first_rank,
    is_close,
    shared_folder,
)
from scenes.elasticity import stress

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")
COMM = MPI.COMM_WORLD

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


def sheared_block(cell):
    """Return the problem of a block that is pressed and sheared, and the block's stress."""
    setup = BlockOnBall(cell=cell)
    setup.problem.small_displacement_tolerance = np.inf
    scene = setup.scene
    if dimension(cell) == 3:
        return setup, stress(scene.u, scene.E, scene.nu)
    return setup, fc.elasticity.LinearElastic(scene.u, scene.E, scene.nu, "plane strain").stress


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_every_frame_shows_one_state(cell, tmp_path, monkeypatch):
    """Every frame shows the deformed body of its step, with common colours, axes and legend."""
    folder = shared_folder(tmp_path)
    setup, sigma = sheared_block(cell)
    bodies, colours, axes, figures = [], [], [], []
    polygons, create_axes, colour_scale = (
        drawing.polygons,
        drawing.create_axes,
        drawing.colour_scale,
    )

    def record_polygons(corners, faces, *rest):
        if not isinstance(faces, str):  # the faces of obstacles are strings
            bodies.append(corners)
            colours.append(faces)
        return polygons(corners, faces, *rest)

    def record_axes(places, *rest):
        axes.append(places.reshape(-1, places.shape[-1]))
        result = create_axes(places, *rest)
        figures.append(result[0])
        return result

    monkeypatch.setattr(drawing, "polygons", record_polygons)
    monkeypatch.setattr(drawing, "create_axes", record_axes)
    film = fc.Animation(
        folder / "new" / "film.gif", setup.problem, stress=sigma, magnification=2.0, rate=4.0
    )
    shape_of, shapes = drawing.ShapeEvaluator(setup.scene.u, sigma), []
    for step in fc.increments(setup.problem, setup.load, 0, 2, steps=4):
        film.add(step)
        shapes.append(shape_of())
    film.save()

    def check():
        with Image.open(folder / "new" / "film.gif") as image:
            assert image.n_frames == 4 and image.info["duration"] == 250
        assert len(bodies) == 4
        largest = max(shape.stress.max() for shape in shapes)
        scale = colour_scale(0.0, largest)
        for shape, body, faces in zip(shapes, bodies, colours, strict=True):
            assert is_close(body, shape.original + 2 * shape.displacement, 1e-14)
            assert is_close(faces, scale.to_rgba(shape.stress), 1e-14)
        assert shapes[0].stress.max() < 0.9 * largest
        (places,) = axes
        everything = np.concatenate([body.reshape(-1, body.shape[2]) for body in bodies])
        assert np.array_equal(places.min(axis=0), everything.min(axis=0))
        assert np.array_equal(places.max(axis=0), everything.max(axis=0))
        (legend,) = figures[0].legends
        labels = ["displacement × 2"]
        labels += ["open", "sticking", "slipping"] if dimension(cell) == 2 else []
        labels.append("rigid obstacle")
        assert [text.get_text() for text in legend.get_texts()] == labels

    check_on_first_rank(check)
    del film
    gc.collect()
    COMM.barrier()
    assert [p.name for p in (folder / "new").iterdir()] == ["film.gif"]  # no temporary files remain


def test_invalid_input_is_refused(tmp_path):
    """Invalid input raises on all ranks, and no file is written."""
    folder = shared_folder(tmp_path)
    setup, sigma = sheared_block("triangle")
    problem, path = setup.problem, folder / "film.gif"
    for call, *words in (
        (lambda: fc.Animation(folder / "film.mp4", problem), "film.mp4", ".gif"),
        (lambda: fc.Animation(path, setup.contact), "problem", "Contact"),
        (lambda: fc.Animation(path, problem, magnification=0), "magnification is 0"),
        (lambda: fc.Animation(path, problem, rate="fast"), "rate is 'fast'"),
        (lambda: fc.Animation(path, problem, view=3.0), "view is 3.0"),
        (lambda: fc.Animation(path, problem, stress=sigma[0, 0]), "shape ()", "(3, 3)"),
        (lambda: fc.Animation(path, problem).save(), "add(step)"),
        (lambda: fc.Animation(path, problem).add(3), "state is 3"),
    ):
        assert_raised_on_all_ranks(call, ValueError, *words)
    COMM.barrier()
    assert not path.exists()


def test_failed_save_leaves_the_previous_file(tmp_path, monkeypatch):
    """If a frame cannot be drawn, all ranks raise, and the file is unchanged."""
    folder = shared_folder(tmp_path)
    setup, _ = sheared_block("triangle")
    film = fc.Animation(folder / "film.gif", setup.problem)
    film.add("at rest")
    film.save()
    COMM.barrier()
    before = (folder / "film.gif").read_bytes()
    film.add("again")

    def raise_error(*arguments):
        raise OSError("no more ink")

    with monkeypatch.context() as patch:
        patch.setattr(drawing, "polygons", raise_error)
        assert_raised_on_all_ranks(film.save, OSError, "no more ink")
    COMM.barrier()
    assert (folder / "film.gif").read_bytes() == before
    assert [p for p in folder.iterdir() if p.suffix == ".gif"] == [folder / "film.gif"]
    COMM.barrier()
    film.save()
