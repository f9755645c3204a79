"""What the runs of `verification/shallow_ironing.py` add up to: values, errors, tables, a picture.

What meshes leave is Richardson's: an order and a limit through all sizes, or where they show no
order the range of their values. All else is a difference of two runs on one mesh. Bars are the sum
of all that is left, each taken as if it went the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fenics_contact import plotting

Rows = Mapping[str, Mapping[str, float]]  # results by name of the run and of the quantity

# As they are called in tables, and in the rows: at 1.5 without the ripple.
QUANTITIES = {"V(1)": "V(1)", "V(1.5)": "fitted V(1.5)", "H(1.5)": "fitted H(1.5)"}
# V(1), V(1.5), H(1.5) [N/mm], read off curves.
PUBLISHED = {
    "Poulios and Renard": (268.0, 337.0, 102.0),
    "Hartmann et al.": (320.0, 408.0, 160.0),
    "Fischer and Wriggers": (298.0, 365.0, 189.0),
    "Yastrebov": (290.0, 360.0, 171.0),
    "Code_Aster": (332.0, 421.0, 143.0),
}
MESHES = {"size 0.4": 0.4, "size 0.283": 0.283, "base": 0.2, "size 0.141": 0.141, "size 0.1": 0.1}
FINE = "size 0.1"
# Where one thing alone is varied but for the variants of the problem.
COARSE = ", size 0.283"
VARIANTS = (
    "isochoric",
    "height 3",
    "isochoric, height 3",
    f"height 5{COARSE}",
    f"friction 0.4{COARSE}",
    f"die 100 times stiffer{COARSE}",
)
# Factors of safety for an order that meshes show, and for one that they do not.
SAFE, UNSAFE = 1.25, 3.0
ORDERS = np.linspace(0.5, 4.0, 701)


@dataclass(frozen=True)
class Limit:
    """Of a mesh sequence.

    Attributes:
        value: The limit; the finest mesh's where no order is seen.
        order: The order, NaN where none is seen.
        error: Bar of the value, of its unit.
    """

    value: float
    order: float
    error: float


def richardson(sizes: Sequence[float], values: Sequence[float]) -> Limit:
    """The limit of values on three meshes or more, from the coarsest to the finest.

    Roache, J. Fluids Eng. 116, 1994, and for more than three Eça and Hoekstra, J. Comput. Phys.
    262, 2014: the values go one way and a + c h^p fits best with p between 1/2 and 4: the error is
    1.25 times the distance from the finest mesh's value and the worst miss of the fit. Else the
    finest value, and 3 times the range of all over largest by least size less one, as if the order
    were one.
    """
    h, f = np.asarray(sizes), np.asarray(values, dtype=float)
    steps = np.diff(f)
    if np.all(steps > 0) or np.all(steps < 0):
        fits = [_fit(h, f, order) for order in ORDERS]
        best = int(np.argmin([miss for _, miss in fits]))
        if 0 < best < len(ORDERS) - 1:
            value, miss = fits[best]
            return Limit(value, ORDERS[best], SAFE * abs(value - f[-1]) + miss)
    return Limit(f[-1], np.nan, UNSAFE * float(np.ptp(f)) / (h.max() / h.min() - 1))


def _fit(h: np.ndarray, f: np.ndarray, order: float) -> tuple[float, float]:
    """Least squares by a + c h^order: a, and how far the worst value is off."""
    terms = np.column_stack([np.ones_like(h), h**order])
    solution = np.linalg.lstsq(terms, f, rcond=None)[0]
    return float(solution[0]), float(np.abs(terms @ solution - f).max())


def meshes(rows: Rows, quantity: str) -> Limit:
    """Of a quantity, from the runs that have it."""
    key = QUANTITIES[quantity]
    found = [(size, rows[name][key]) for name, size in MESHES.items() if key in rows[name]]
    return richardson(*zip(*found, strict=True))


def differences(rows: Rows, quantity: str) -> dict[str, float]:
    """Of a quantity, by run: how far it is from the run that differs in one thing alone."""
    key = QUANTITIES[quantity]
    found = {}
    for name, row in rows.items():
        _, on_another, size = name.partition(", size ")
        other = f"size {size}" if on_another else "base"
        if key in row and name != other:
            found[name] = row[key] - rows[other][key]
    return found


def contributions(rows: Rows, quantity: str) -> dict[str, float]:
    """To the bar of a quantity, by what they come from [N/mm]."""
    moved = differences(rows, quantity)
    mesh = meshes(rows, quantity)
    pressing = quantity == "V(1)"
    steps = "80 increments of pressing" if pressing else "360 increments of sliding"
    # Springs give way as 1/k: what k leaves is half of what is between k/3 and k.
    springs = -moved[f"a third of the stiffness{COARSE}"] / 2
    return {
        "mesh": mesh.error,
        "enforcement": abs(moved[f"augmented{COARSE}"] - springs),
        "increments": abs(moved[steps + COARSE]),
        "quadrature of Γc": abs(moved[f"quadrature of degree 16{COARSE}"]),
        "side with Γc": abs(moved[f"Γc of slab{COARSE}"]),
        "ripple": 0.0 if pressing else rows[FINE][f"ripple of {quantity[0]}"],
    }


def converged(rows: Rows, quantity: str) -> tuple[float, float]:
    """A quantity and its bar [N/mm]: the limit of the meshes, without what the springs give way."""
    mesh = meshes(rows, quantity)
    value = mesh.value + differences(rows, quantity)[f"augmented{COARSE}"]
    return value, sum(contributions(rows, quantity).values())


# ---- tables --------------------------------------------------------------------------------------


def table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """In Markdown."""
    lines = ["| " + " | ".join(row) + " |" for row in (head, *body)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def bare(name: str) -> str:
    """Of a run, without its mesh."""
    return name.removesuffix(COARSE)


def answers(rows: Rows) -> str:
    """Converged values, variants and what is published."""
    found = [converged(rows, quantity) for quantity in QUANTITIES]
    values = [value for value, _ in found]
    bars = [f"**{value:.1f} ± {error:.1f}**" for value, error in found]
    body = [["converged", *bars, f"**{values[2] / values[1]:.3f}**"]]
    for name in VARIANTS:
        moved = [
            value + differences(rows, q)[name] for q, value in zip(QUANTITIES, values, strict=True)
        ]
        body.append(
            [bare(name), *(f"{value:.1f}" for value in moved), f"{moved[2] / moved[1]:.3f}"]
        )
    for name, points in PUBLISHED.items():
        body.append([name, *(f"{value:.0f}" for value in points), f"{points[2] / points[1]:.2f}"])
    return table(("N/mm", *QUANTITIES, "H/V at 1.5"), body)


def factors(rows: Rows) -> str:
    """What each run changes, but for variants."""
    body = [["base", *(f"{rows['base'][key]:.2f}" for key in QUANTITIES.values())]]
    moved = [differences(rows, quantity) for quantity in QUANTITIES]
    for name in rows:
        if name not in ("base", *VARIANTS):
            body.append([name, *(f"{one[name]:+.2f}" if name in one else "" for one in moved)])
    return table(("N/mm", *QUANTITIES), body)


def budget(rows: Rows) -> str:
    """The bars, piece by piece."""
    parts = [contributions(rows, quantity) for quantity in QUANTITIES]
    body = [[name, *(f"{one[name]:.2f}" for one in parts)] for name in parts[0]]
    body.append(["**sum**", *(f"**{sum(one.values()):.2f}**" for one in parts)])
    return table(("error [N/mm] from", *QUANTITIES), body)


# ---- the picture ---------------------------------------------------------------------------------


def corrected(
    rows: Rows, name: str, t: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The base's curve, V or H, led to the limit, and its bar.

    Both in proportion: as found at t = 1 before (of V, for H as well), as at 1.5 after, and
    linearly between them.
    """
    scales, bars = [], []
    for quantity in ("V(1)", f"{name}(1.5)"):
        value, error = converged(rows, quantity)
        scales.append(value / rows["base"][QUANTITIES[quantity]])
        bars.append(error / value)
    limit = values * np.interp(t, (1.0, 1.5), scales)
    return limit, np.abs(limit) * np.interp(t, (1.0, 1.5), bars)


def draw(file: Path, rows: Rows, curves: Mapping[str, np.ndarray]) -> None:
    """V and H over t: the converged curve, variants, and what is published.

    Args:
        file: PNG to write.
        rows: Of the study.
        curves: By run: t, V and H, shape (n, 3).
    """
    with plotting.figure(file, 2, (6.8, 5.2)) as axes:
        for ax, name, column in zip(axes, "VH", (1, 2), strict=True):
            t = curves["base"][:, 0]
            limit, bar = corrected(rows, name, t, curves["base"][:, column])
            ax.fill_between(t, limit - bar, limit + bar, color="k", alpha=0.25, lw=0)
            ax.plot(t, limit, "k", lw=1.5, label="converged, and its error")
            for i, each in enumerate(VARIANTS):
                points = curves[each]
                ax.plot(points[:, 0], points[:, column], f"C{i}", lw=1, label=bare(each))
            for marker, (program, values) in zip("osD^v", PUBLISHED.items(), strict=True):
                at, shown = ((1.0, 1.5), values[:2]) if name == "V" else ((1.5,), values[2:])
                style = {"ms": 8, "mec": "k", "mfc": "w", "ls": "", "zorder": 5}
                ax.plot(at, shown, marker, label=program, **style)
            words = {"V": "vertical force V", "H": "horizontal force H"}[name]
            ax.set(xlabel="time: pressed to 1, dragged to 2 [–]", xlim=(0, 2))
            ax.set(ylabel=f"{words} on the slab [N/mm]", ylim=(0, None))
            ax.grid(alpha=0.25)
        axes[1].legend(loc="upper left", fontsize="small")
