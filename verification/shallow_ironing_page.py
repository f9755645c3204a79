"""Evaluation of the runs of `verification/shallow_ironing.py`: limits, errors, page and figures.

The mesh error is estimated by Richardson extrapolation over all mesh sizes, or from the range of
the values if no convergence order is observed. All other contributions are differences of two runs
on one mesh. The error is the sum of all contributions, as if they had the same sign.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fenics_contact import plotting
from verification import report

Rows = Mapping[str, Mapping[str, float]]  # results by name of the run and of the quantity

# Names in the tables and in the rows; values at t = 1.5 are fitted, without the oscillation.
QUANTITIES = {"V(1)": "V(1)", "V(1.5)": "fitted V(1.5)", "H(1.5)": "fitted H(1.5)"}
# V(1), V(1.5), H(1.5) [N/mm], read from published curves.
PUBLISHED = {
    "Poulios and Renard": (268.0, 337.0, 102.0),
    "Hartmann et al.": (320.0, 408.0, 160.0),
    "Fischer and Wriggers": (298.0, 365.0, 189.0),
    "Yastrebov": (290.0, 360.0, 171.0),
    "Code_Aster": (332.0, 421.0, 143.0),
}
MESHES = {"size 0.4": 0.4, "size 0.283": 0.283, "base": 0.2, "size 0.141": 0.141, "size 0.1": 0.1}
FINE = "size 0.1"
# Mesh on which one parameter is varied.
COARSE = ", size 0.283"
VARIANTS = (
    "isochoric",
    "height 3",
    "isochoric, height 3",
    f"height 5{COARSE}",
    f"friction 0.4{COARSE}",
    f"die 100 times stiffer{COARSE}",
)
# Safety factors with and without an observed convergence order.
SAFETY_FACTOR_ORDER, SAFETY_FACTOR_NO_ORDER = 1.25, 3.0
ORDERS = np.linspace(0.5, 4.0, 701)


@dataclass(frozen=True)
class Limit:
    """Limit of a mesh sequence.

    Attributes:
        value: The limit; the value of the finest mesh if no order is observed.
        order: The convergence order, NaN if none is observed.
        error: Error of the value, in its unit.
    """

    value: float
    order: float
    error: float


def richardson(sizes: Sequence[float], values: Sequence[float]) -> Limit:
    """Return the limit of values on three meshes or more, from the coarsest to the finest.

    Roache, J. Fluids Eng. 116, 1994; for more than three meshes Eça and Hoekstra, J. Comput. Phys.
    262, 2014. If the values are monotonic and a + c h^p fits best with p between 1/2 and 4, the
    error is 1.25 times the distance from the value of the finest mesh, plus the largest misfit.
    Otherwise the limit is the finest value, and the error 3 times the range of all values over
    largest size / smallest size - 1, as for order one.
    """
    h, f = np.asarray(sizes), np.asarray(values, dtype=float)
    steps = np.diff(f)
    if np.all(steps > 0) or np.all(steps < 0):
        fits = [_fit(h, f, order) for order in ORDERS]
        best = int(np.argmin([miss for _, miss in fits]))
        if 0 < best < len(ORDERS) - 1:
            value, miss = fits[best]
            return Limit(value, ORDERS[best], SAFETY_FACTOR_ORDER * abs(value - f[-1]) + miss)
    return Limit(f[-1], np.nan, SAFETY_FACTOR_NO_ORDER * float(np.ptp(f)) / (h.max() / h.min() - 1))


def _fit(h: np.ndarray, f: np.ndarray, order: float) -> tuple[float, float]:
    """Fit a + c h^order by least squares; return a and the largest misfit."""
    terms = np.column_stack([np.ones_like(h), h**order])
    solution = np.linalg.lstsq(terms, f, rcond=None)[0]
    return float(solution[0]), float(np.abs(terms @ solution - f).max())


def mesh_limit(rows: Rows, quantity: str) -> Limit:
    """Return the mesh limit of a quantity, from the runs that have a value of it."""
    key = QUANTITIES[quantity]
    found = [(size, rows[name][key]) for name, size in MESHES.items() if key in rows[name]]
    return richardson(*zip(*found, strict=True))


def differences(rows: Rows, quantity: str) -> dict[str, float]:
    """Return, by run, the change of a quantity from run "size …" of its name, or else "base"."""
    key = QUANTITIES[quantity]
    found = {}
    for name, row in rows.items():
        _, on_another, size = name.partition(", size ")
        other = f"size {size}" if on_another else "base"
        if key in row and name != other:
            found[name] = row[key] - rows[other][key]
    return found


def contributions(rows: Rows, quantity: str) -> dict[str, float]:
    """Return the contributions to the error of a quantity, by source [N/mm]."""
    moved = differences(rows, quantity)
    mesh = mesh_limit(rows, quantity)
    pressing = quantity == "V(1)"
    steps = "80 increments of pressing" if pressing else "360 increments of sliding"
    # The penalty error is proportional to 1/k: half of the difference between k/3 and k.
    penalty = -moved[f"a third of the stiffness{COARSE}"] / 2
    return {
        "mesh": mesh.error,
        "enforcement": abs(moved[f"augmented{COARSE}"] - penalty),
        "increments": abs(moved[steps + COARSE]),
        "quadrature of Γc": abs(moved[f"quadrature of degree 16{COARSE}"]),
        "side with Γc": abs(moved[f"Γc of slab{COARSE}"]),
        "oscillation": 0.0 if pressing else rows[FINE][f"ripple of {quantity[0]}"],
    }


def converged_value(rows: Rows, quantity: str) -> tuple[float, float]:
    """Return a quantity and its error [N/mm]: limit of the meshes, corrected for the penalty."""
    mesh = mesh_limit(rows, quantity)
    value = mesh.value + differences(rows, quantity)[f"augmented{COARSE}"]
    return value, sum(contributions(rows, quantity).values())


# ---- page ----------------------------------------------------------------------------------------


def page(rows: Rows) -> str:
    """Return the page in Markdown."""
    lines = ["# Shallow ironing", ""]
    lines += report.text(
        "A widely published test: an elastic die is pressed by 1 mm into an elastic slab and slid "
        "along it by 10 mm, μ = 0.3 (definition: `demos/shallow_ironing.py`). Published results "
        "differ by 25 % in the vertical force V and by a factor of 1.9 in the horizontal force H. "
        "This page gives a converged solution with its error; t = 1 is the end of pressing, "
        "t = 1.5 half of the sliding distance."
    )
    lines += value_table(rows)
    lines += ["![Vertical and horizontal force over time](shallow-ironing.png)", ""]
    lines += report.text(
        "*Converged forces with their error (grey), variants of the problem, and published values, "
        "read from curves. The converged curve is that of the base mesh, scaled to the limits at "
        "t = 1 and t = 1.5.*",
        "- **Runs**: quadratic triangles, a penalty of E/h of the die, increments of a fifth of a "
        "facet; one parameter is varied at a time, variants on meshes of size 0.2 and 0.283. All "
        "meshes have the penalty stiffness of the base, size 0.2. Rows and curves: "
        "`verification/shallow_ironing.csv` and `shallow_ironing_curves.csv`.",
        "- **At t = 1.5** forces oscillate, as facets pass under the die; values are those of a "
        "parabola fitted from 1.4 to 1.6.",
        "- **Converged value**: limit of the meshes, corrected by the difference between augmented "
        "Lagrangian and penalty. If the meshes show a convergence order between 1/2 and 4, the "
        "limit is Richardson's and the error 1.25 times the extrapolation; otherwise the value is "
        "that of the finest mesh and the error 3 times the range of all values, divided by "
        "(largest size / smallest size - 1).",
    )
    lines += ["## Error", "", *error_table(rows)]
    lines += report.text(
        "The sum assumes that all contributions have the same sign. Enforcement: difference "
        "between the augmented Lagrangian and the extrapolation of two penalty stiffnesses in 1/k. "
        "Increments, quadrature and slave side: the whole change that they cause. Oscillation: "
        "amplitude on the finest mesh."
    )
    lines += ["![Changes by parameter](shallow-ironing-changes.png)", ""]
    lines += report.text(
        "*Change of the forces by one parameter, relative to the run on the same mesh; bars: error "
        "of the converged values.*",
        "- The **penalty** has the largest effect on V with quadratic elements: with E/h of the "
        "die V is 0.5 % too small.",
        "- **Γc on the slab** takes 4.3 times the iterations and gives 0.3 % less force.",
        "- **Degree**: cubic elements of size 0.283 are within 0.2 % of the limit; linear ones of "
        "size 0.141 give 1.0 and 1.5 % more V, and 0.4 % less H.",
        "- **Coarser and finer cells of the die** over the same slab change all three forces by "
        "less than their errors.",
    )
    lines += ["## Comparison with published values", ""]
    lines += report.text(
        "- The **isochoric** energy gives 7 to 8 % more; then V agrees with Code_Aster to 1 %, and "
        "H is 7 % lower, slightly more than the error.",
        "- **Height**: 1 mm more of slab gives 14 and 10 % less, which is V(1) of Poulios and "
        "Renard to 1 %, V(1.5) to 4 % and H to 8 %. 1 mm less gives 23 and 16 % more, above all "
        "published values.",
        "- A rigid **die** gives 7 % more; V of Hartmann et al. is between this and the converged "
        "values.",
        "- **Not explained**: V of Fischer and Wriggers and of Yastrebov, 3 to 8 % lower, and all "
        "published H from 143 N/mm on. At μ = 0.3 all variants have H/V from 0.31 to 0.35; a ratio "
        "of 0.39 to 0.52 requires more friction.",
        "Agreement of a variant with a program does not prove that the program solved this "
        "variant.",
        "Written by `python verification/shallow_ironing.py`; `--page` writes the page and its "
        "figures from the stored runs.",
    )
    return "\n".join(lines).rstrip() + "\n"


def short_name(name: str) -> str:
    """Return the name of a run without its mesh."""
    return name.removesuffix(COARSE)


def value_table(rows: Rows) -> list[str]:
    """Return the table of converged values, variants and published values."""
    found = [converged_value(rows, quantity) for quantity in QUANTITIES]
    values = [value for value, _ in found]
    bars = [f"**{value:.1f} ± {error:.1f}**" for value, error in found]
    body = [["converged", *bars, f"**{values[2] / values[1]:.3f}**"]]
    for name in VARIANTS:
        moved = [
            value + differences(rows, q)[name] for q, value in zip(QUANTITIES, values, strict=True)
        ]
        body.append(
            [short_name(name), *(f"{value:.1f}" for value in moved), f"{moved[2] / moved[1]:.3f}"]
        )
    for name, points in PUBLISHED.items():
        body.append([name, *(f"{value:.0f}" for value in points), f"{points[2] / points[1]:.2f}"])
    return report.table(("N/mm", *QUANTITIES, "H/V at 1.5"), body)


def error_table(rows: Rows) -> list[str]:
    """Return the table of contributions to the error."""
    parts = [contributions(rows, quantity) for quantity in QUANTITIES]
    body = [[name, *(f"{one[name]:.2f}" for one in parts)] for name in parts[0]]
    body.append(["**sum**", *(f"**{sum(one.values()):.2f}**" for one in parts)])
    return report.table(("error [N/mm] from", *QUANTITIES), body)


# ---- figures -------------------------------------------------------------------------------------


def scale_curve(
    rows: Rows, name: str, t: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the curve of the base run, V or H, scaled to the limit, and its error.

    Scale and relative error are those of V(1) up to t = 1, also for H, and those at 1.5 from
    t = 1.5 on, with linear interpolation in between.
    """
    scales, bars = [], []
    for quantity in ("V(1)", f"{name}(1.5)"):
        value, error = converged_value(rows, quantity)
        scales.append(value / rows["base"][QUANTITIES[quantity]])
        bars.append(error / value)
    limit = values * np.interp(t, (1.0, 1.5), scales)
    return limit, np.abs(limit) * np.interp(t, (1.0, 1.5), bars)


def draw(file: Path, rows: Rows, curves: Mapping[str, np.ndarray]) -> None:
    """Draw V and H over t: the converged curve, variants, and published values.

    Args:
        file: PNG to write.
        rows: Rows of the study.
        curves: t, V and H by run, shape (n, 3).
    """
    with plotting.figure(file, 2, (6.8, 5.2)) as axes:
        for ax, name, column in zip(axes, "VH", (1, 2), strict=True):
            t = curves["base"][:, 0]
            limit, bar = scale_curve(rows, name, t, curves["base"][:, column])
            ax.fill_between(t, limit - bar, limit + bar, color="k", alpha=0.25, lw=0)
            ax.plot(t, limit, "k", lw=1.5, label="converged, with error")
            for i, each in enumerate(VARIANTS):
                points = curves[each]
                ax.plot(points[:, 0], points[:, column], f"C{i}", lw=1, label=short_name(each))
            for marker, (program, values) in zip("osD^v", PUBLISHED.items(), strict=True):
                at, shown = ((1.0, 1.5), values[:2]) if name == "V" else ((1.5,), values[2:])
                style = {"ms": 8, "mec": "k", "mfc": "w", "ls": "", "zorder": 5}
                ax.plot(at, shown, marker, label=program, **style)
            words = {"V": "vertical force V", "H": "horizontal force H"}[name]
            ax.set(xlabel="time t: pressing to 1, sliding to 2 [–]", xlim=(0, 2))
            ax.set(ylabel=f"{words} on the slab [N/mm]", ylim=(0, None))
            ax.grid(alpha=0.25)
        axes[1].legend(loc="upper left", fontsize="small")


def draw_changes(file: Path, rows: Rows) -> None:
    """Draw the relative changes of the forces by parameter, with the errors of the limits."""
    moved = {quantity: differences(rows, quantity) for quantity in QUANTITIES}
    names = [name for name in rows if name not in ("base", *VARIANTS)]
    with plotting.figure(file, size=(9.0, 5.0)) as axes:
        for i, (quantity, marker) in enumerate(zip(QUANTITIES, "osv", strict=True)):
            value, error = converged_value(rows, quantity)
            at = [n for n, name in enumerate(names) if name in moved[quantity]]
            changes = [100 * moved[quantity][names[n]] / value for n in at]
            axes.plot(changes, at, marker, color=f"C{i}", markersize=5, label=quantity)
            width = 100 * error / value
            axes.axvspan(-width, width, color=f"C{i}", alpha=0.12, lw=0)
        axes.axvline(0.0, color="k", linewidth=0.8)
        axes.set_yticks(range(len(names)), names, fontsize=8)
        axes.set(xlabel="change [%]", ylim=(len(names) - 0.4, -0.6))
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8)
