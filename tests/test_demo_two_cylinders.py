"""The demo of two cylinders, pressed and sheared, against Cattaneo and Mindlin."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_cattaneo_mindlin(tmp_path: Path) -> None:
    """a, c and p₀ are within 2 % of the published numbers of the half-plane theory.

    a/R = 0.085 changes a by 1 % and p₀ by 0.5 % on any mesh; the points are 1.1 % of a apart. The
    forces are those of the loads, to 1e-7.
    """
    result = run_demo("two_cylinders", tmp_path)
    computed = reference_values(result)
    assert computed["force along y [N/mm]"] == pytest.approx(16 * 0.625, rel=1e-7)
    assert computed["force along x [N/mm]"] == pytest.approx(16 * 0.05851, rel=1e-7)
    assert computed["half-width of contact [mm]"] == pytest.approx(0.68078, rel=0.02)
    assert computed["half-width of stick zone [mm]"] == pytest.approx(0.72933 * 0.68078, rel=0.02)
    assert computed["largest pressure [MPa]"] == pytest.approx(9.3514, rel=0.02)
    for name in ("shear", "traction", "mesh"):
        assert (tmp_path / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    for name in ("body", "contact", "contact_points"):
        assert (tmp_path / f"{name}.pvd").exists()


@pytest.mark.slow
def test_number_of_increments_has_no_effect(tmp_path: Path) -> None:
    """Under monotonic shear the slip zone only grows: one increment agrees with four.

    All values agree to 0.1 %, the error of the largest shear at the end of the stick zone; the
    forces agree to 1e-7.
    """
    once = run_demo("two_cylinders", tmp_path / "1", "--cells", "20", "--increments", "1")
    four_increments = run_demo(
        "two_cylinders", tmp_path / "4", "--cells", "20", "--increments", "4"
    )
    assert reference_values(once) == pytest.approx(reference_values(four_increments), rel=1e-3)


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Two ranks agree with one to 1e-6; the solver stops at 1e-9 of the forces."""
    options = ("--cells", "20", "--increments", "1")
    serial = run_demo("two_cylinders", tmp_path / "1", *options)
    parallel = run_demo("two_cylinders", tmp_path / "2", *options, ranks=2)
    assert reference_values(parallel) == pytest.approx(reference_values(serial), rel=1e-6)
