"""Animations of load histories (GIF). Needs matplotlib."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fenics_contact.arguments import check_instance, check_positive
from fenics_contact.parallel import collective_errors
from fenics_contact.problem import ContactProblem
from fenics_contact.results import drawing, files
from fenics_contact.results.obstacles import ObstacleShape, box_about, shapes_of
from fenics_contact.results.writer import facet_status
from fenics_contact.step import Step
from fenics_contact.types import Array

__all__ = ["Animation"]

# Colours of a body without stress, and of the edges of its cells.
_BODY, _EDGES = "#e3ebf5", "#11111180"


class Animation:
    """An animation of a problem's states, one frame per call of `add`, written by `save`.

    It shows the deformed body, coloured by its von Mises stress if ``stress`` is given, rigid
    obstacles, and in the plane the status of Γc: grey where open, blue where sticking, red where
    slipping. All frames have the same axes and colour scale, and are therefore drawn by `save`;
    until then their data are in temporary files in the folder of the animation. The constructor is
    collective.

    Args:
        path: GIF file to write; its folder is created if necessary.
        problem: The problem.
        stress: UFL tensor (3, 3) on the body.
        magnification: Factor of the displacements drawn.
        unit: Unit of length, for the axes.
        stress_unit: Unit of stress, for the colour bar.
        title: Title of every frame, before its own text.
        view: Elevation and azimuth of the camera in degrees, in space.
        rate: Frames per second.

    Attributes:
        path: The GIF file.

    Raises:
        ValueError: An argument is invalid; raised on all ranks.
        OSError: The folder cannot be created or written to; raised on all ranks.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        problem: ContactProblem,
        *,
        stress: Any = None,
        magnification: float = 1.0,
        unit: str = "mm",
        stress_unit: str = "MPa",
        title: str = "",
        view: tuple[float, float] | None = None,
        rate: float = 5.0,
    ) -> None:
        check_instance("problem", problem, ContactProblem)
        if not isinstance(path, str | os.PathLike) or Path(path).suffix.lower() != ".gif":
            raise ValueError(f"path is {path!r}; it must be the name of a file that ends with .gif")
        for name, value in (("magnification", magnification), ("rate", rate)):
            check_positive(name, value)
        drawing.check_view(view)
        self.path, self._problem = Path(path), problem
        self._magnification, self._rate = float(magnification), float(rate)
        self._texts = unit, stress_unit, title
        self._view = view
        self._comm = problem.u.function_space.mesh.comm
        self._shape = drawing.ShapeEvaluator(problem.displacement.u, stress)
        self._n_frames = 0
        self._folder = Path()  # temporary folder of the frames' data, on the first rank
        self._obstacles: list[ObstacleShape] = []  # on the first rank
        with collective_errors(self._comm):
            if self._comm.rank == 0:
                drawing.pyplot()  # raises an error without matplotlib
                self._obstacles = shapes_of(problem.contacts)
                files.make_folder(self.path.parent)
                # Not /tmp, which may be a small file system in memory.
                folder, prefix = self.path.parent, f".{self.path.stem}."
                self._folder = Path(tempfile.mkdtemp(dir=folder, prefix=prefix))
                weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)

    def add(self, state: Step | str) -> None:
        """Add the present state as the next frame. Collective.

        The interior displacement is recovered first, if it is out of date.

        Args:
            state: The `Step`, whose increment and load are the title of the frame; or a title.

        Raises:
            ValueError: ``state`` is neither.
            OSError: The disk is full; the frame is omitted. Raised on all ranks.
        """
        if isinstance(state, Step):
            title = f"increment {state.increment}"
            title += "" if state.load is None else f", load {state.load:.4g}"
        elif isinstance(state, str):
            title = state
        else:
            raise ValueError(f"state is {state!r}; it must be a Step, or a title (str)")
        self._problem.complete()
        self._problem.displacement.update()
        shape, ends, status = self._shape(), [], []
        if self._problem.displacement.u.function_space.mesh.topology.dim == 2:
            for contact in self._problem.contacts:
                facets = drawing.gather_facets(contact, facet_status(contact))
                if facets is not None:
                    ends.append(facets[0] + self._magnification * facets[1])
                    status.append(facets[2])
        with collective_errors(self._comm):
            if shape is not None:
                frame = {"body": shape.deformed(self._magnification), "title": np.array(title)}
                if shape.stress is not None:
                    frame["stress"] = shape.stress
                if ends:
                    frame |= {"ends": np.concatenate(ends), "status": np.concatenate(status)}
                frame |= {f"obstacle {i}": o.state() for i, o in enumerate(self._obstacles)}
                np.savez(self._frame_path(self._n_frames), **frame)  # type: ignore[arg-type]
        self._n_frames += 1

    def save(self) -> None:
        """Write the animation of all states so far; more may be added later. Collective.

        Raises:
            ValueError: There are no frames.
            OSError: The file cannot be written and is unchanged; raised on all ranks.
        """
        if not self._n_frames:
            raise ValueError(f"{self.path} would have no frame; call add(step) first")
        with collective_errors(self._comm):
            if self._comm.rank == 0:
                frames = self._render()
                first = next(frames)
                with files.atomic_write(self.path) as temporary:
                    first.save(
                        temporary,
                        save_all=True,
                        append_images=frames,
                        duration=round(1000 / self._rate),
                        loop=0,
                    )

    def _frame_path(self, number: int) -> Path:
        return self._folder / f"{number:06d}.npz"

    def _frames(self) -> Iterator[dict[str, Array]]:
        """Read the data of the frames, one at a time."""
        for number in range(self._n_frames):
            with np.load(self._frame_path(number)) as frame:
                yield dict(frame)

    def _render(self) -> Iterator[Any]:
        """Draw the frames as Pillow images, one at a time."""
        from matplotlib.patches import Patch
        from PIL import Image

        # Limits of axes and colours over all frames.
        corners, largest, has_surfaces = [], 0.0, False
        for frame in self._frames():
            has_surfaces |= "ends" in frame
            flat = frame["body"].reshape(-1, frame["body"].shape[2])
            corners.append(np.array([flat.min(axis=0), flat.max(axis=0)]))
            largest = max(largest, frame.get("stress", np.zeros(0)).max(initial=0.0))
        unit, stress_unit, title = self._texts
        margin = drawing.MARGIN[bool(self._obstacles)]
        bounds = np.array(corners)
        figure, axes = drawing.create_axes(bounds, unit, title, self._view, margin)
        box = box_about(bounds, margin)
        colours = drawing.colour_scale(0.0, largest)
        label = drawing.magnification_label(self._magnification)
        handles = [Patch(fc=_BODY, ec=_EDGES, label=label)]
        handles += drawing.status_handles() if has_surfaces else []
        if self._obstacles:
            handles.append(drawing.obstacle_handle(box.shape[1]))
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
        try:
            for number, frame in enumerate(self._frames()):
                faces: Any = _BODY
                if "stress" in frame:
                    faces = colours.to_rgba(frame["stress"])
                    if number == 0:
                        bar = {"label": f"von Mises stress [{stress_unit}]", "shrink": 0.8}
                        figure.colorbar(colours, ax=axes, **bar)
                body = drawing.polygons(frame["body"], faces, _EDGES, 0.2)
                artists = [axes.add_collection(body)]
                if "ends" in frame:
                    line_colours = drawing.status_colours(frame["status"])
                    line = drawing.facet_collection(frame["ends"], line_colours)
                    line.set_linewidth(3.0)
                    artists.append(axes.add_collection(line))
                for i, shape in enumerate(self._obstacles):
                    surface = shape(box, self._magnification, frame[f"obstacle {i}"])
                    if len(surface):
                        artists.append(axes.add_collection(drawing.obstacle_collection(surface)))
                axes.set_title(f"{title}: {frame['title']}" if title else str(frame["title"]))
                figure.canvas.draw()
                image = Image.fromarray(np.array(figure.canvas.buffer_rgba())).convert("RGB")
                yield image.quantize()
                for artist in artists:
                    artist.remove()
        finally:
            drawing.pyplot().close(figure)
