"""Problems of `benchmarks/trade.py`, and the settings to solve them with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import timing
from fenics_contact.contact.accuracy import PRESETS
from scenes.problems import (
    ContactScene,
    ball_on_half_space,
    greco,
    greco_block,
    half_cylinder,
    hertz,
    rings,
    shrink_fit,
    sphere,
)

Row = timing.Row
QUANTITIES = ("normal force", "friction force", "peak pressure", "displacement")


@dataclass(frozen=True)
class Setting:
    """One configuration: a problem, its mesh, and all parameters.

    Attributes:
        scene: Name of the problem.
        h: Cell size at Γc: a length, for the ball in units of the contact radius.
        degree: Polynomial degree of the displacement.
        k_n: Normal stiffness in units of E/h.
        k_t: Tangential stiffness in units of k_n.
        enforcement: "penalty" or "augmented".
        tolerance: Tolerance of the augmented Lagrangian method.
        quadrature: Quadrature degree on Γc, "vertex", or "default".
        increments: Number of equal increments.
        rtol: ``snes_rtol``.
        solver: Method of the problem: "lbfgs", "newton" or "default".
        accuracy: Preset that sets stiffness, enforcement and tolerances instead, if any.
    """

    scene: str
    h: float
    degree: int = 2
    k_n: float = 10.0
    k_t: float = 1.0
    enforcement: str = "penalty"
    tolerance: float = 1e-5
    quadrature: str = "default"
    increments: int = 1
    rtol: float = 1e-9
    solver: str = "default"
    accuracy: str = ""


# Parameters that change the compiled forms.
COMPILED = ("degree", "enforcement", "quadrature", "accuracy")
PARAMETERS = tuple(field.name for field in fields(Setting) if field.name != "scene")
COLUMNS = (
    "role",
    "scene",
    *PARAMETERS,
    "failure",
    "dofs",
    "steps",
    "iterations",
    "augmentations",
    "method",
)
COLUMNS += (*QUANTITIES, *(f"{name} error" for name in QUANTITIES), "error")
COLUMNS += ("seconds", "linear solve [s]", "time")


@dataclass(frozen=True)
class Scene:
    """A problem on all its meshes.

    Attributes:
        name: Name of the problem.
        make: Creates the body with a cell size.
        sizes: Cell sizes, coarsest first, including that of ``base``.
        base: Base setting.
        reference: Setting of the reference solution; None if there is an exact solution.
        published: Published values by quantity.
        source: Source of the published values.
    """

    name: str
    make: Callable[[float], ContactScene]
    sizes: tuple[float, ...]
    base: Setting
    reference: Setting | None
    published: dict[str, float]
    source: str

    @property
    def has_friction(self) -> bool:
        """Whether the problem has friction."""
        return self.make(self.sizes[0]).friction > 0


def scene(
    name: str,
    make: Callable[[float], ContactScene],
    sizes: Sequence[float],
    base: float,
    finest: float | None,
    published: dict[str, float],
    source: str,
    increments: tuple[int, int] = (1, 1),
) -> Scene:
    """Create a problem with an augmented Lagrangian reference of tight tolerances."""
    start = Setting(name, base, increments=increments[0])
    tight = {"enforcement": "augmented", "tolerance": 1e-7, "rtol": 1e-10}
    reference = None
    if finest is not None:
        reference = replace(start, h=finest, increments=increments[1], **tight)
    return Scene(name, make, tuple(sizes), start, reference, published, source)


def all_scenes() -> dict[str, Scene]:
    """Return the problems of the full study."""
    hertz_ball = sphere.hertz("block", 4e-4, 0.0)
    p, bore, _ = shrink_fit.lame("plane strain")
    sizes = (0.42, 0.2, 0.1, 0.05)
    exact = [hertz.EXACT[mu] for mu in (0.0, 0.2)]
    cylinder = [
        {
            "normal force": hertz.R * hertz.PAPER_LOAD,
            "friction force": values["tangential_resultant"],
            "peak pressure": values["peak_pressure"],
            "displacement": values["top_centre_displacement"][1],
        }
        for values in exact
    ]
    independent = "independent solution, exact complementarity"
    made = [
        scene(
            "half-cylinder",
            partial(half_cylinder, 0.0, smooth=True),
            sizes,
            0.05,
            0.025,
            cylinder[0],
            independent,
        ),
        scene(
            "half-cylinder μ=0.2",
            partial(half_cylinder, 0.2, smooth=True),
            sizes,
            0.05,
            0.025,
            cylinder[1],
            independent,
            (20, 320),
        ),
        scene(
            "GRECO block",
            lambda h: greco_block(round(greco.SIZE / h)),
            (5.0, 2.5, 1.25),
            1.25,
            40 / 96,
            {
                "normal force": 2000.0,
                "friction force": greco.SHEAR,
                "displacement": greco.CONVERGED[0],
            },
            independent,
        ),
        scene(
            "ball on block",
            lambda h: ball_on_half_space(round(1 / h)),
            (1 / 3, 1 / 4, 1 / 6),
            1 / 4,
            1 / 9,
            {
                "normal force": hertz_ball["force [N]"] / 4,
                "peak pressure": hertz_ball["peak pressure [MPa]"],
                "displacement": -4e-4,
            },
            "Hertz, a/R = 0.02",
        ),
        scene(
            "shrink fit",
            rings,
            (4.0, 2.0, 1.0, 0.5),
            1.0,
            None,
            {
                "normal force": p * np.pi / 2 * shrink_fit.JOINT,
                "peak pressure": p,
                "displacement": bore,
            },
            "Lamé, exact",
        ),
    ]
    return {one.name: one for one in made}


def short_scenes() -> dict[str, Scene]:
    """Return the problems of a short study: coarse meshes of the half-cylinder."""
    made = []
    for one in list(all_scenes().values())[:2]:
        steps = 4 if one.has_friction else 1
        assert one.reference is not None
        base = replace(one.base, h=0.42, increments=steps)
        reference = replace(one.reference, h=0.2, increments=steps)
        made.append(replace(one, sizes=(0.42,), base=base, reference=reference))
    return {one.name: one for one in made}


def sweep(one: Scene, short: bool) -> list[Setting]:
    """Return the settings of a problem, which vary one parameter at a time, and the mesh."""
    base, friction = one.base, one.has_friction
    if short:
        return [
            base,
            replace(base, k_n=100.0),
            replace(base, enforcement="augmented"),
            replace(base, solver="newton"),
        ]
    values: dict[str, Sequence[Any]] = {
        "k_n": (0.1, 1.0, 100.0, 1e3, 1e4, 1e6),
        "quadrature": ("3", "5", "7", "vertex"),
        "increments": (1, 2, 5, 10, 20, 40, 80) if friction else (1, 5),
        "rtol": (1e-2, 1e-3, 1e-4, 1e-6, 1e-12),
        "solver": ("lbfgs", "newton"),
        "accuracy": (
            *PRESETS,
            "0.003",
            *(() if one.make(one.sizes[0]).is_path_dependent else ("1e-4",)),
        ),
    }
    if friction:
        values["k_t"] = (0.01, 0.1, 10.0, 100.0)
    made = [base]
    for h in one.sizes:
        for degree in (1, 2):
            for enforcement in ("penalty", "augmented"):
                made.append(replace(base, h=h, degree=degree, enforcement=enforcement))
    made += [replace(base, **{name: v}) for name, some in values.items() for v in some]
    augmented = replace(base, enforcement="augmented")
    made += [replace(augmented, k_n=k) for k in (1.0, 100.0, 1e3)]
    made += [replace(augmented, tolerance=t) for t in (0.1, 1e-2, 1e-3, 1e-7)]
    made += [replace(augmented, tolerance=t, rtol=0.1 * t) for t in (1e-2, 1e-3)]
    made += [replace(base, degree=1, quadrature="vertex")]
    return list(dict.fromkeys(made))
