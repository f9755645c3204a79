"""The HTML report of a history: well-formed, self-contained, and with the correct numbers."""

import base64
import csv
from html.parser import HTMLParser

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.results import drawing
from scenes.block_on_ball import BlockOnBall
from scenes.blocks import block
from scenes.comparison import assert_raised_on_all_ranks, is_close, shared_folder
from scenes.elasticity import stress
from scenes.histories import BlockOnBallHistory, BlockOnRamp
from scenes.rubber import DiscOnRubber

pytest.importorskip("matplotlib")
COMM = MPI.COMM_WORLD
PNG = b"\x89PNG\r\n\x1a\n"
EMPTY = {"meta", "img"}  # elements without an end

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


class Page(HTMLParser):
    """The contents of a report, as a browser reads it.

    Attributes:
        tables: Rows of cells by caption.
        pictures: Bytes by caption.
        text: The whole text.
        outside: Addresses of anything that is not in the file.
    """

    def __init__(self, path):
        """Read the file, on all ranks."""
        super().__init__()
        COMM.barrier()
        self.tables, self.pictures, self.text, self.outside = {}, {}, "", []
        self._open, self._rows, self._caption = [], [], ""
        self.feed(path.read_text(encoding="utf-8"))
        COMM.barrier()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        """Store pictures, addresses and the beginning of a table cell."""
        attributes = dict(attrs)
        for name in ("src", "href"):
            address = attributes.get(name)
            if address is not None and not address.startswith("data:image/png;base64,"):
                self.outside.append(address)
            elif address is not None:
                self.pictures[attributes["alt"]] = base64.b64decode(
                    address.split(",")[1], validate=True
                )
        if tag == "tr":
            self._rows.append([])
        if tag in ("th", "td"):
            self._rows[-1].append("")
        if tag not in EMPTY:
            self._open.append(tag)

    def handle_endtag(self, tag):
        """Close an element, and store the rows of a table."""
        assert self._open.pop() == tag
        if tag == "table":
            self.tables.setdefault(self._caption, self._rows)
            self._rows, self._caption = [], ""

    def handle_data(self, data):
        """Store the text of the page, of a caption or of a cell."""
        if "style" in self._open:
            assert "url(" not in data and "@import" not in data
            return
        self.text += data
        if self._open and self._open[-1] == "caption":
            self._caption += data
        elif self._open and self._open[-1] in ("th", "td"):
            self._rows[-1][-1] += data

    def check(self, problem, steps):
        """Check everything that a report of any problem must contain."""
        assert self.outside == []
        assert all(picture.startswith(PNG) for picture in self.pictures.values())
        plane = problem.u.function_space.mesh.geometry.dim == 2
        # Deformed body, history of each contact and of all; 2 or 5 captions common to all contacts.
        assert len(self.pictures) == 2 + len(problem.contacts) + (2 if plane else 5)
        assert "verification passed" in self.text and "verification failed" not in self.text
        small = any(not contact.contact_kinematics.is_finite for contact in problem.contacts)
        assert ("that displacements are small" in self.text) == small
        assert {"Verdict: holds", "Problem", "Versions"} <= self.tables.keys()
        assert ["fenics_contact", fc.__version__] in self.tables["Versions"]
        for contact in problem.contacts:
            chosen = dict(self.tables[f"Contact: {contact.name}"])
            assert chosen["law"] == type(contact.law).__name__
            assert chosen["obstacle"] == type(contact.obstacle).__name__
            assert chosen["kinematics"] == (
                "finite" if contact.contact_kinematics.is_finite else "small"
            )
            for name, constant in contact.parameters.items():
                value = ", ".join(f"{x:g}" for x in np.ravel(constant.value))
                scaled = isinstance(getattr(contact.law, name, None), fc.RelativeStiffness)
                assert chosen[name] == value + (" E/h" if scaled else "")
        extents = self.tables["Extents on the undeformed surface"]  # of the first contact only
        extent_by_state = steps[-1].contacts[problem.contacts[0].name].extents
        for (name, area, *_), (state, extent) in zip(
            extents[1:], extent_by_state.items(), strict=True
        ):
            assert name == state and area == f"{extent.area:.6g}"
        residual = f"{steps[-1].verdict.relative_residual:.1e}"
        assert f"The residual is {residual} of the forces" in self.text


@pytest.fixture
def curves(monkeypatch):
    """Record the curves drawn on the first rank: x and y by the labels of y axis and curve."""
    drawn_curves, save = {}, drawing.save

    def record_figure(figure, path):
        for axes in figure.axes:
            for line in axes.get_lines():
                key = axes.get_ylabel(), line.get_label()
                drawn_curves.setdefault(key, []).append(np.array(line.get_data()))
        save(figure, path)

    monkeypatch.setattr(drawing, "save", record_figure)
    return drawn_curves


def drawn_curve(curves, key, n=0):
    """Return the n-th curve of a key, broadcast from the first rank to all ranks."""
    return COMM.bcast(curves[key][n] if COMM.rank == 0 else None)


def test_report_of_a_restarted_history(tmp_path, curves):
    """Two contacts, multipliers, a load reversal, and a restart: curves contain all increments.

    References: the steps of both runs.
    """
    folder = shared_folder(tmp_path)
    files = {"checkpoint": folder / "state.npz", "csv": folder / "history.csv"}

    def press():
        return BlockOnBallHistory(wall=True, contact={"enforcement": "augmented"})

    steps = []
    for step in press().increments(3.0, **files):
        steps.append(step)
        if step.increment == 3:
            break
    setup = press()
    steps += list(setup.increments(3.0, **files))
    scene = setup.scene
    body = fc.elasticity.LinearElastic(scene.u, scene.E, scene.nu, "plane strain")
    budget = fc.estimate_errors(setup.problem, stress(scene.u, scene.E, scene.nu))
    path = fc.report(
        setup.problem,
        steps[-1],
        folder / "new" / "folder",
        csv=files["csv"],
        stress=body.stress,
        budget=budget,
        title="<b>one & two</b>",
        units=("m", "kN", "kPa"),
    )
    assert path == folder / "new" / "folder" / "report.html"
    page = Page(path)
    page.check(setup.problem, steps)
    assert "<b>one & two</b>" in page.text and "Increments 1 to 6" in page.text
    assert "per m of thickness" in page.text
    assert page.tables["Error budget"][0][1:] == list(budget.values)
    assert "augmented" in dict(page.tables["Contact: floor"])["enforcement"]
    assert dict(page.tables["Contact: wall"])["enforcement"] == "penalty"
    loads = [step.load for step in steps]
    for n, name in enumerate(("floor", "wall")):
        for i, axis in enumerate("xy"):
            x, y = drawn_curve(curves, ("force on the body [kN/m]", f"force {axis}"), n)
            assert is_close(x, loads, 1e-14)
            assert is_close(y, [step.contacts[name].force[i] for step in steps], 1e-14)
        x, y = drawn_curve(curves, ("moment about the origin [kN m/m]", "moment z"), n)
        assert is_close(y, [step.contacts[name].moment[0] for step in steps], 1e-14)
        x, y = drawn_curve(curves, ("area [m²/m]", "stick"), n)
        assert is_close(y, [step.contacts[name].extents["stick"].area for step in steps], 1e-14)
    x, y = drawn_curve(curves, ("energy [kN m/m]", "dissipation by friction"))
    assert is_close(y, np.cumsum([step.energy.dissipation for step in steps]), 1e-14)
    # At the points near the contact: the values of `gather`.
    points = setup.problem.contacts[0].gather()
    x, y = drawn_curve(curves, ("traction [kPa]", "pressure"))
    assert is_close([y.max()], [points["pressure"].max()], 1e-14)
    assert set(x) <= set(points["x"][:, 0])


def block_in_space():
    """Return the problem, steps and stress of a block in space."""
    setup = BlockOnBall(cell="tetrahedron")
    setup.problem.small_displacement_tolerance = np.inf
    steps = list(fc.increments(setup.problem, setup.load, 0, 2, steps=2))
    return setup.problem, steps, stress(setup.scene.u, setup.scene.E, setup.scene.nu)


def two_bodies_with_pair_updates():
    """Return the problem and steps of two bodies whose pairs are updated."""
    ramp = BlockOnRamp()
    return ramp.problem, list(ramp.increments(1.0)), None


def rubber_under_disc():
    """Return the problem and steps of rubber under a disc with large displacements."""
    setup = DiscOnRubber()
    return setup.problem, list(setup.increments(1.0)), None


def single_step():
    """Return the problem and one step without a load parameter, not committed."""
    setup = BlockOnBall(fc.Coulomb(0.3))
    setup.problem.small_displacement_tolerance = np.inf
    setup.set_top_displacement(0.01, 0.03)
    return setup.problem, setup.problem.solve(), None


@pytest.mark.each
@pytest.mark.parametrize(
    "scene",
    [block_in_space, two_bodies_with_pair_updates, rubber_under_disc, single_step],
    ids=lambda f: f.__name__,
)
def test_report_of_every_kind_of_problem(scene, tmp_path, curves):
    """Reports in space, between bodies, with large displacements, and of a step not committed."""
    problem, steps, sigma = scene()
    path = fc.report(problem, steps, shared_folder(tmp_path), stress=sigma)
    steps = [steps] if isinstance(steps, fc.Step) else steps
    Page(path).check(problem, steps)
    per = "/mm" if problem.contacts[0].points.shape[1] == 2 else ""
    force = drawn_curve(curves, (f"force on the body [N{per}]", "force y"))
    name = problem.contacts[0].name
    assert is_close(force[1], [step.contacts[name].force[1] for step in steps], 1e-14)
    loads = [step.increment if step.load is None else step.load for step in steps]
    assert is_close(force[0], loads, 1e-14)


def test_report_of_an_unloaded_body(tmp_path):
    """A body is pressed and released: without forces a residual has no meaningful relative value.

    This holds for the log line, the table of a step, the report and the CSV file; a residual that
    is round-off is stated as 0. A displacement that is round-off is not magnified by 1e20.
    """
    folder = shared_folder(tmp_path)
    scene = block("quadrilateral", degree=2, n=4)
    problem, _ = scene.problem(fc.Coulomb(0.3), scene.rollers())
    steps = []
    for start, end in ((0.0, -3.0), (-3.0, 0.0)):
        load = fc.increments(
            problem, lambda p: scene.load(up=p), start, end, steps=2, csv=folder / "h.csv"
        )
        steps += list(load)
    for step in steps:
        loaded = step is not steps[-1]
        assert ("; no forces; " in step.summary()) != loaded
        assert ("; no forces</p>" in step._repr_html_()) != loaded
        assert step.verdict.is_loaded == loaded
    assert steps[-1].contacts["contact"].normal_force != 0.0  # round-off, as required here
    assert "; contact: no contact force" in steps[-1].summary()
    assert "stick" not in steps[-1].summary() and "stick" in steps[0].summary()
    assert steps[-1].verdict.relative_residual == 0.0
    page = Page(fc.report(problem, steps, folder, csv=folder / "h.csv"))
    assert "All forces are zero." in page.text and "of the forces." not in page.text
    assert "The contact force is zero" in page.text and "e+" not in " ".join(page.pictures)
    rows = (folder / "h.csv").read_text().splitlines()
    residuals = [row["residual (share of the forces)"] for row in csv.DictReader(rows)]
    assert residuals[-1] == "" and all(0 <= float(r) < 1e-9 for r in residuals[:-1])


def test_invalid_input_is_refused(tmp_path):
    """Invalid input is refused on all ranks, before any work; no report is written."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBall()
    setup.problem.small_displacement_tolerance = np.inf
    first, step = fc.increments(
        setup.problem, setup.load, 0, 1, steps=2, csv=folder / "history.csv"
    )
    problem, page = setup.problem, folder / "page"
    if COMM.rank == 0:
        lines = (folder / "history.csv").read_text().splitlines(keepends=True)
        (folder / "short.csv").write_text("".join(lines[:2]))
        (folder / "other.csv").write_text("a,b\n1,2\n")
        (folder / "empty.csv").write_text(lines[0])
    COMM.barrier()
    several = (each for each in [step])
    for words, arguments, options in (
        (("problem",), (setup.contact, step, page), {}),
        (
            ("steps is a generator", "list(increments"),
            (problem, several, page),
            {},
        ),
        (("steps is empty",), (problem, [], page), {}),
        (("increments [1]", "at increment 2"), (problem, first, page), {}),
        (("increments [2, 2]",), (problem, [step, step], page), {}),
        (("folder is 3",), (problem, step, 3), {}),
        (("csv is 3",), (problem, step, page), {"csv": 3}),
        (("last increment is 1",), (problem, step, page), {"csv": folder / "short.csv"}),
        (("no column 'increment'",), (problem, step, page), {"csv": folder / "other.csv"}),
        (("or is empty",), (problem, step, page), {"csv": folder / "empty.csv"}),
        (("shape ()", "(3, 3)"), (problem, step, page), {"stress": setup.scene.E}),
        (("budget is a float",), (problem, step, page), {"budget": 0.1}),
        (("title",), (problem, step, page), {"title": 1}),
        (("units is 'mm'",), (problem, step, page), {"units": "mm"}),
        (("magnification is -1",), (problem, step, page), {"magnification": -1}),
        (("view is (1, 2, 3)",), (problem, step, page), {"view": (1, 2, 3)}),
    ):
        assert_raised_on_all_ranks(
            lambda a=arguments, o=options: fc.report(*a, **o), ValueError, *words
        )
    missing = folder / "missing.csv"
    assert_raised_on_all_ranks(
        lambda: fc.report(problem, step, page, csv=missing), OSError, "missing.csv"
    )
    assert_raised_on_all_ranks(
        lambda: fc.report(problem, step, folder / "other.csv"), OSError, "other.csv"
    )
    COMM.barrier()
    assert not (page / "report.html").exists()


def test_failure_keeps_the_previous_report(tmp_path, monkeypatch):
    """If a picture cannot be drawn, all ranks raise the error, and the report is unchanged."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBall()
    setup.problem.small_displacement_tolerance = np.inf
    (step,) = fc.increments(setup.problem, setup.load, 0, 1)
    path = fc.report(setup.problem, step, folder)
    COMM.barrier()
    before = path.read_bytes()

    def raise_error(figure, path):
        raise OSError("no more ink")

    monkeypatch.setattr(drawing, "save", raise_error)
    assert_raised_on_all_ranks(
        lambda: fc.report(setup.problem, step, folder), OSError, "no more ink"
    )
    COMM.barrier()
    assert path.read_bytes() == before and [p.name for p in folder.iterdir()] == ["report.html"]
