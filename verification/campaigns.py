"""Outcomes of the campaigns of random scenes: docs/random_scenes.md and its figure.

python verification/campaigns.py

The outcomes are the rows of ``verification/campaign*.csv``, written by `verification/fuzz.py`; no
scenes are solved.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

from fenics_contact import plotting
from scenes.processes import ROOT
from verification import report

PAGE = ROOT / "docs" / "random_scenes.md"
DATA = ROOT / "verification"
# Campaigns of the page: file and number of ranks.
CAMPAIGNS = {
    "small displacements": ("campaign.csv", "1"),
    "the same, 2 ranks": ("campaign.csv", "2"),
    "the same, 3 ranks": ("campaign.csv", "3"),
    "unrelated bodies, thin obstacles, long paths": ("campaign_mixed.csv", "1"),
    "the same, later": ("campaign_mixed_later.csv", "1"),
    "the same, latest": ("campaign_mixed_latest.csv", "1"),
    "finite kinematics, rigid obstacles": ("campaign_finite.csv", "1"),
    "finite kinematics, rigid obstacles, later": ("campaign_finite_later.csv", "1"),
    "finite kinematics, two bodies": ("campaign_bodies.csv", "1"),
    "finite kinematics, two bodies, later": ("campaign_bodies_later.csv", "1"),
    "finite kinematics, dissimilar bodies": ("campaign_unlike.csv", "1"),
}
# The latest campaigns, in which the causes of refusals are counted.
LATEST = {
    "mixed": "the same, latest",
    "rigid obstacles": "finite kinematics, rigid obstacles, later",
    "two bodies": "finite kinematics, two bodies, later",
    "dissimilar bodies": "finite kinematics, dissimilar bodies",
}
# Labels and colours of the outcomes on the page, by their names in the files.
OUTCOMES = {
    "right": ("correct", "#4c9f70"),
    "another": ("other equilibrium", "#a3c9a8"),
    "refused": ("refused", "#f0b44c"),
    "slow": ("slow", "#c9c9c9"),
    "unjudged": ("unjudged", "#8f8f8f"),
    "crashed": ("crashed", "#7a3b69"),
    "wrong": ("wrong", "#d1342f"),
}
# Reasons for refusal on the page, by their names in the file.
REASONS = {
    "ValueError: not held": "a body is unconstrained",
    "ValueError: load not balanced": "no contact force can balance the load",
    "ValueError: no potential": "the requested method requires a potential",
    "NotConverged: not converged": "not converged, or verification failed",
}
# Causes of the refusals of increments that the independent solver solves: words of features or
# message, the first that applies.
CAUSES = {
    "iteration limit": "the scene limits the number of iterations",
    "has no potential": "the requested method requires a potential",
    "nor contact constrain": "a rigid-body mode is free, though no force acts along it",
    "has crossed": "Γc passes through the obstacle, mostly a thin rod",
    "penetrates between": "penetration between quadrature points",
    "too large for the small": "displacements are too large for small-displacement kinematics",
    "with a round-off of": "forces are as small as the round-off of translated bodies",
    "friction supplies": "friction supplies energy",
    "": "no solution found",
}
Row = dict[str, str]


def read_campaigns() -> dict[str, list[Row]]:
    """Return the rows of every campaign by its title."""
    files = {name: report.read(DATA / name) for name, _ in CAMPAIGNS.values()}
    return {
        title: [row for row in files[name] if row["ranks"] == ranks]
        for title, (name, ranks) in CAMPAIGNS.items()
    }


def page(rows_by_campaign: dict[str, list[Row]]) -> str:
    """Return the page in Markdown."""
    counts = {
        title: Counter(row["outcome"] for row in rows) for title, rows in rows_by_campaign.items()
    }
    total = sum(map(len, rows_by_campaign.values()))
    wrong = sum(count["wrong"] for count in counts.values())
    increments = sum(
        int(row["increments"] or 0) for rows in rows_by_campaign.values() for row in rows
    )
    lines = ["# Random scenes", ""]
    lines += report.text(
        f"**{wrong} of {total} random scenes had a wrong result when they were run**, of which 4 "
        "are not explained ([below](#wrong-results)). Every scene is solved by the package and by "
        f"an independent solver, {increments:,} increments in all; 1748 scenes that were run "
        "before are not in the table."
    )
    lines += ["![Outcomes by campaign](random_scenes.png)", ""]
    names = [label for label, _ in OUTCOMES.values()]
    body = [
        (title, len(rows_by_campaign[title]), *(counts[title][o] for o in OUTCOMES))
        for title in rows_by_campaign
    ]
    lines += report.table(("campaign", "scenes", *names), body)
    lines += report.text(
        '*"Other equilibrium": another solution for the same loads, which friction permits. '
        '"Slow": time limit exceeded. "Unjudged": the independent solver took too long.*'
    )
    lines += ["## Scenes and independent solver", ""]
    lines += report.text(
        "`python verification/fuzz.py --scenes N --resume results.csv` generates scenes of one to "
        "three bodies in 2D and 3D: cell types and degrees; obstacles at rest, moving or driven by "
        "a force; all laws; prescribed gaps; forces over six decades; loading, unloading, reversal "
        "and reloading; halved increments, restarts, pair updates, units, enforcement, accuracy "
        "and methods; one rank or several (`--ranks`). The bulk is written in seven equivalent "
        "forms. A scene is identified by its seed (`--seed`); failing scenes are reduced by "
        "`--minimise`.",
        "The independent solver (`verification/reference_solver.py`) shares only DOLFINx's "
        "assembly of the bulk: geometry, pairing, projection, laws, condensation and solution are "
        "its own. `tests/test_fuzz.py` has a hundred scenes, and those that were once wrong. All "
        "outcomes are in `verification/campaign.csv` and similar files; `python "
        "verification/fuzz.py --table FILE` counts them by feature.",
        "- **Unrelated bodies, thin obstacles, long paths** (`--mixed`): all generators, with an "
        "unrelated loaded body in the same mesh in a quarter of the scenes; plates, blades and "
        "pins thinner than a facet that are pressed, slid past an end or moved through; sliding "
        "by up to 2.5 widths, displacements by up to 30 lengths.",
        "- **Finite kinematics, rigid obstacles** (`--finite`): eleven kinds of obstacles that "
        "move and rotate, up to a full turn; linear and neo-Hookean bodies, compressed by 0.2 to "
        "25 %, sliding by up to 0.4 of their width. Distances, normals, slip and return map of the "
        "independent solver (`verification/finite_reference.py`) are closed formulas or brute "
        "force, derivatives finite differences. It checks whether u is an equilibrium with its own "
        "history, and solves this history in small steps. Energies are not compared.",
        "- **Finite kinematics, two bodies** (`--bodies`): a block on a slab, both linear or "
        "rubber, pressed by up to 13 % of its height or by a force, slid by up to 1.5 widths and "
        "over the end, lifted and lowered again, and rotated; Γc on either body, ratios of facet "
        "numbers up to 20 and of moduli up to 3000. The independent solver "
        "(`verification/sliding_reference.py`) intersects rays with every facet.",
        "- **Dissimilar bodies** (`--bodies --extreme`): ratios of moduli of 1e3 to 1e6, facets "
        "of up to 20 times the width.",
    )
    lines += ["## Wrong results", ""]
    later = rows_by_campaign["the same, later"]
    latest = rows_by_campaign["the same, latest"]
    solved = sum(row["kind"] == "NotConverged: not converged (solved apart)" for row in later)
    required = sum("rightly" in row["kind"] for row in later)
    lines += report.text(
        "- Seed 900161 (three bodies, augmented Lagrangian, unloading, restart): a multiplier has "
        "an error of 1.4e-8, the independent solver allows 2.9e-9. Which of the two is wrong is "
        "not known.",
        "- Seed 807869 (two bodies, an unrelated one with 1e8 times their load) was verified with "
        "a tolerance relative to the largest force; it is correct now.",
        "- The other mixed scenes: one is an error of the independent solver (804811). Corrected "
        "are: slip of a body that follows its obstacle in the increment in which it is positioned "
        "(804145); a pin of 6 % of a facet that passes through in small increments (804158); "
        "round-off of a removed load, taken as contact force (804043, 805153, 805155, 805171); "
        "cells inverted at a vertex (804316); pins that pass between quadrature points (804679, "
        "805229, 805231), most of them with one point per facet, which is refused now.",
        "- 1748 mixed scenes were run before those of the file. Of all 3273, 84 were wrong and 6 "
        "crashed: 35 thin obstacles passed through Γc undetected, 11 had wrong slip of an obstacle "
        "pressed by a force, 25 were errors of the independent solver. All crashes were a NumPy "
        "warning. The causes are corrected; 26 of 30 that were solved again are correct or "
        "refused.",
        f"- Of the later {len(later)} mixed scenes {solved} did not converge and were solved by "
        f"the independent solver, and {required} refusals are required by the geometry. In one a "
        "pin penetrated slowly into a flat cell (813024), and in one the midpoints of quadratic "
        "facets passed through the obstacle between the points of vertex quadrature (814618): both "
        "are refused now. In one a point is 1e-9 of the length away from the vertex of a polygon, "
        "whose normal there has a round-off of 5e-8 (815370).",
        f"- Of the {len(latest)} latest mixed scenes six were wrong. For a "
        "body that slides back onto its obstacle from beyond its end the first contact in the "
        "increment was detected too late (817254); it is correct now. The independent solver "
        "allowed a slanted rod no more depth at the corner of a coarse body than a flat one "
        "(817479); its limit has the slope now. A multiplier differs by 3 % more than the "
        "tolerance (818660), which is not explained. Of the methods without a limit on iterations "
        "two failed without naming round-off: a removed load whose round-off was estimated as "
        "zero after a restart (818207), which is correct now, and a body strained by 3e-6 that is "
        "displaced by 29 lengths, which is solved without that displacement (818871). Facets that "
        "face several others of a rotated body were divided at the wrong places, by both solvers "
        "(819161; correct now up to a load that no contact force balances), and a slanted rod "
        "passed through a quadrature point (819149; refused now). The independent solver took the "
        "centreline of a pin for its surface (819411).",
        "- Not explained, besides the first, are a penetration with multipliers 10 % above the "
        "tolerance, on a single facet (815746), and a slip reference 1e-4 of the body's size "
        "inside the obstacle, a plate that slides past the body (815922).",
        "- In two of the later scenes of two bodies with finite kinematics (1400, 1424) the "
        "comparison took the distance from points on a facet as long as the body for the distance "
        "from the facet. It is taken from the facet now, and both are correct.",
        "- Errors detected earlier by scenes of two bodies are corrected and tested: a resumed "
        "history refused because of the round-off of a prescribed zero, a NumPy error for a "
        "flattened surface, a residual of 5e-7 of a soft body's forces taken as the round-off of "
        "a stiff one (`tests/test_scales.py`), and a displacement of 1e-12 at Dirichlet nodes.",
    )
    lines += ["## Refusals", ""]
    rows = [r for r in rows_by_campaign["small displacements"] if r["outcome"] == "refused"]
    kinds = Counter(row["kind"] for row in rows)
    body = [
        (
            text,
            kinds[f"{kind} (solved apart)"],
            kinds[f"{kind} (not solved apart)"],
        )
        for kind, text in REASONS.items()
    ]
    lines += report.text(
        "Reasons for refusal with small displacements on one rank, and whether the independent "
        "solver solved the increment:"
    )
    lines += report.table(("reason", "solved independently", "not solved"), body)
    campaigns = [rows_by_campaign[title] for title in LATEST.values()]
    causes = [count_causes(rows) for rows in campaigns]
    lines += report.text(
        "Causes of the refusals that the independent solver, which has the same quadrature points "
        "and does not verify the path of obstacles, solves, in the latest campaigns (number of "
        "scenes in brackets):"
    )
    lines += report.table(
        ("cause", *(f"{t} ({len(rows)})" for t, rows in zip(LATEST, campaigns, strict=True))),
        [(cause, *(counts[cause] for counts in causes)) for cause in CAUSES.values()],
    )
    lines += report.text(
        "- Of the first 533 scenes that did not converge although the independent solver found a "
        "solution, 201 had limited iterations or halvings; the others are loads that the package "
        "should have solved, or refuses intentionally, such as a body that passes through Γc "
        "between its points.",
        "- First mixed scenes: 82 did not converge and were solved by the independent solver; 69 "
        "refusals are required by the geometry.",
        "- Dissimilar bodies: in 13 of 18 refusals the opposing surface penetrates Γc between its "
        "points; in 12 of these Γc is a single facet.",
    )
    lines += ["## Limits of the comparison", ""]
    lines += report.text(
        "- Scenes were run once, with the package of that time. Scenes that were wrong by an error "
        "of the independent solver were run again after its correction.",
        "- Errors of the independent solver were: integrals between curved facets; round-off if Γc "
        "is a single point; the non-uniqueness of friction multipliers at constrained nodes; "
        "penalty forces at points that lost their pairs; the nearest point of a friction polygon; "
        "multipliers in the kernel of the coupling matrix; the penetration of bodies that were not "
        "positioned; residuals relative to the forces that move a body with its obstacle.",
        "- In 8 correct scenes with finite kinematics and rigid obstacles, and in 18 with "
        "dissimilar bodies, the independent solver did not reach the end of the history.",
        "- Seeds from 600000 on are families of 12 (`--alike 12`), from 720000 on of 48, that "
        "differ in numbers, loads, methods and histories.",
        "- Dissimilar bodies: 58 scenes were run again when the default stiffness became that of "
        "the softer body: 41 are correct (28 before), 6 refused (12), 7 slow (11), 4 unjudged (7).",
    )
    lines += report.text(
        "Written by `python verification/campaigns.py` from the stored outcomes. See also "
        "[extreme parameters](extremes.md)."
    )
    return "\n".join(lines).rstrip() + "\n"


def count_causes(rows: list[Row]) -> Counter[str]:
    """Count the causes of refusals of increments that the independent solver solves."""
    counts: Counter[str] = Counter()
    for row in rows:
        if row["outcome"] == "refused" and row["kind"].endswith("(solved apart)"):
            text = row["features"] + row["detail"]
            counts[next(cause for words, cause in CAUSES.items() if words in text)] += 1
    return counts


def draw_outcomes(path: Path, rows_by_campaign: dict[str, list[Row]]) -> None:
    """Draw the fractions of the outcomes of every campaign."""
    titles = [f"{title} ({len(rows)})" for title, rows in rows_by_campaign.items()]
    with plotting.figure(path, size=(9.0, 3.4)) as axes:
        left = [0.0] * len(rows_by_campaign)
        for outcome, (label, colour) in OUTCOMES.items():
            widths = [
                100 * sum(row["outcome"] == outcome for row in rows) / len(rows)
                for rows in rows_by_campaign.values()
            ]
            if any(widths):
                axes.barh(
                    range(len(rows_by_campaign)), widths, left=left, color=colour, label=label
                )
            left = [a + b for a, b in zip(left, widths, strict=True)]
        axes.set_yticks(range(len(rows_by_campaign)), titles, fontsize=8)
        axes.set(xlabel="scenes [%]", xlim=(0, 100), ylim=(len(rows_by_campaign) - 0.4, -0.6))
        axes.figure.legend(loc="outside upper right", ncols=6, fontsize=8)


def main() -> int:
    """Write the page and its figure."""
    rows_by_campaign = read_campaigns()
    PAGE.write_text(page(rows_by_campaign))
    draw_outcomes(PAGE.with_suffix(".png"), rows_by_campaign)
    return 0


if __name__ == "__main__":
    sys.exit(main())
