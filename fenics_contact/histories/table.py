"""Tables of load histories (CSV): one row per increment."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Resultants
from fenics_contact.parallel import collective_errors
from fenics_contact.problem import ContactProblem
from fenics_contact.results import files
from fenics_contact.step import Step

__all__ = [
    "AXES",
    "ENERGIES",
    "STATES",
    "Table",
    "column",
    "columns",
    "energy_column",
    "is_per_thickness",
    "read_rows",
    "row_values",
]

AXES = "xyz"
STATES = ("contact", "stick", "slip")
ENERGIES = ("work", "elastic", "springs", "dissipation", "remainder")
# First columns of every table; a file that begins with other text is not overwritten.
_FIRST_COLUMNS = ("increment", "load")
_HEADER_START = ",".join(_FIRST_COLUMNS)
_PER_THICKNESS = " per thickness"


class Table:
    """A file of comma-separated values (CSV), written by the first rank.

    A row is written when its increment is committed. In the plane forces, moments, areas and
    energies are per unit thickness, and the header states it, unless the contacts have a weight.
    The constructor is collective. ``errors`` are quantities with error estimates in the steps.

    Raises:
        ValueError: The folder does not exist, or the file is no table; raised on all ranks.
        OSError: The file cannot be written; raised on all ranks.
    """

    def __init__(self, path: Path, problem: ContactProblem, errors: Sequence[str] = ()) -> None:
        self._path, self._problem, self._errors = path, problem, tuple(errors)
        self._comm = problem.u.function_space.mesh.comm
        names = columns(problem)
        names += [f"error of {name} by the increments ({_unit(name)})" for name in self._errors]
        self._header = _line(names)
        with collective_errors(self._comm):
            if self._comm.rank == 0:
                self._check()

    def _check(self) -> None:
        files.check_file(self._path)
        files.check_folder("csv", self._path)
        exists = self._path.exists()
        with open(self._path, "a+", newline="", encoding="utf-8") as file:
            file.seek(0)
            try:
                start = file.read(len(_HEADER_START))
            except UnicodeDecodeError:
                start = "no text"
        if not exists:
            self._path.unlink()
        if start and start != _HEADER_START:
            raise ValueError(
                f"csv is {self._path}, an existing file that is no table of increments and would "
                "be overwritten: give another name, or remove it"
            )

    def truncate(self) -> None:
        """Discard the rows after the last committed increment. Collective.

        Raises:
            ValueError: The rows have other columns, or are damaged; raised on all ranks.
            OSError: The file cannot be written and is unchanged; raised on all ranks.
        """
        with collective_errors(self._comm):
            if self._comm.rank == 0:
                lines = self._committed_lines() if self._problem.increment else []
                with files.atomic_write(self._path) as path:
                    path.write_bytes("".join([self._header, *lines]).encode())

    def _committed_lines(self) -> list[str]:
        """Return the lines of the file up to the last committed increment."""
        if not self._path.exists():
            return []
        header, *lines = self._path.read_bytes().decode().splitlines(keepends=True) or [""]
        if header not in ("", self._header):
            raise ValueError(
                f"{self._path} is of other contacts, or of a history with other estimates: its "
                "columns differ; give another name, or remove it"
            )
        if lines and not lines[-1].endswith("\n"):
            lines.pop()  # incomplete, because the run was interrupted
        committed, n = [], len(next(csv.reader([self._header])))
        for number, line in enumerate(lines, start=2):
            row = next(csv.reader([line]))
            if len(row) != n or not row[0].isdigit():
                raise ValueError(f"{self._path} is damaged in line {number}; remove it")
            if int(row[0]) <= self._problem.increment:
                committed.append(line)
        return committed

    def add(self, step: Step) -> None:
        """Append the row of a committed increment. Collective.

        Raises:
            OSError: The file cannot be written and is unchanged; raised on all ranks.
        """
        row = row_values(self._problem, step)
        errors = step.increment_error or {}
        row += [errors.get(name, "") for name in self._errors]
        with collective_errors(self._comm):
            if self._comm.rank == 0:
                self._append(_line(row).encode())

    def _append(self, line: bytes) -> None:
        size = self._path.stat().st_size
        try:
            with open(self._path, "ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            os.truncate(self._path, size)
            raise


def columns(problem: ContactProblem) -> list[str]:
    """Return names and units of the columns, without those of errors."""
    names = [*_FIRST_COLUMNS]
    for contact in problem.contacts:
        names += [column(contact, *each) for each in _contact_columns(contact)]
    names += [energy_column(problem, name) for name in ENERGIES]
    return [*names, "residual (share of the forces)", "method", "iterations", "cuts"]


def is_per_thickness(problem: ContactProblem) -> bool:
    """Return whether energies are per unit thickness (`Inputs.per_thickness` of any contact)."""
    return any(contact.inputs.per_thickness for contact in problem.contacts)


def energy_column(problem: ContactProblem, name: str) -> str:
    """Return name and unit of the column of one of `ENERGIES`."""
    return f"{name} (force length{_PER_THICKNESS if is_per_thickness(problem) else ''})"


def column(contact: Contact, name: str, unit: str) -> str:
    """Return name and unit of a column of a contact; integrals may be per unit thickness."""
    integral = unit in ("force", "force length", "area") and contact.inputs.per_thickness
    return f"{contact.name}: {name} ({unit}{_PER_THICKNESS if integral else ''})"


def row_values(problem: ContactProblem, step: Step) -> list[object]:
    """Return the values of a row, without errors; "" for missing values."""
    row: list[object] = [step.increment, "" if step.load is None else step.load]
    for contact in problem.contacts:
        row += _contact_values(step.contacts[contact.name])
    row += [getattr(step.energy, name) for name in ENERGIES]
    row.append(step.verdict.relative_residual if step.verdict.is_loaded else "")
    row += [step.method, step.iterations]
    return [*row, sum(attempt.method == "cut" for attempt in step.attempts)]


def read_rows(path: Path, problem: ContactProblem) -> list[dict[str, str]]:
    """Read the rows of a table, by column. On the calling rank only.

    Raises:
        ValueError: The file is no table of a history of these contacts.
    """
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except UnicodeDecodeError:
        rows = []
    missing = [name for name in columns(problem) if not rows or rows[0].get(name) is None]
    if missing:
        raise ValueError(
            f"csv is {path}, which is no table of increments of these contacts, or is empty: there "
            f"is no column {missing[0]!r}; give the file written by increments(csv=...)"
        )
    if None in rows[-1].values():
        rows.pop()  # incomplete, because the run was interrupted
    return rows


def _contact_columns(contact: Contact) -> list[tuple[str, str]]:
    """Return names and units of the columns of a contact."""
    d = contact.surface.mesh.geometry.dim
    moment_axes = AXES if d == 3 else "z"
    return [
        *((f"force {axis}", "force") for axis in AXES[:d]),
        ("normal force", "force"),
        ("friction as the sum of sizes", "force"),
        *((f"moment {axis} about the origin", "force length") for axis in moment_axes),
        *((f"area in {state}", "area") for state in STATES),
        *(
            (f"{state} {end} {axis}", "length")
            for state in STATES
            for end in ("from", "to")
            for axis in AXES[:d]
        ),
        ("largest pressure", "stress"),
        ("largest penetration", "length"),
        *((state, "points") for state in ("open", "stick", "slip")),
    ]


def _contact_values(r: Resultants) -> list[object]:
    """Return the values of the columns of a contact; "" for extents without points."""
    extents = [r.extents[state] for state in STATES]
    ends = np.concatenate([end for e in extents for end in (e.low, e.high)])
    return [
        *(float(value) for value in r.force),
        *(r.normal_force, r.tangential_force),
        *(float(value) for value in r.moment),
        *(e.area for e in extents),
        *("" if np.isnan(end) else float(end) for end in ends),
        *(r.max_pressure, r.max_penetration, r.open, r.stick, r.slip),
    ]


def _unit(quantity: str) -> str:
    """Return the unit of a quantity of an `ErrorBudget`."""
    kind = quantity.rsplit(" ", 1)[-1]
    return {"force": "force", "pressure": "stress", "displacement": "length"}[kind]


def _line(row: Sequence[object]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(row)
    return text.getvalue()
