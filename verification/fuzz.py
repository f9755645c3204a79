"""Solves random scenes and compares them with an independent solver, to detect wrong results.

    docker/run python verification/fuzz.py --seed 17                  # one scene
    docker/run python verification/fuzz.py --scenes 1000 --resume results.csv
    docker/run python verification/fuzz.py --scenes 200 --ranks 2 --resume results2.csv
    docker/run python verification/fuzz.py --scenes 9000 --alike 12 --resume more.csv  # faster
    docker/run python verification/fuzz.py --finite --scenes 300 --alike 12 --resume finite.csv
    docker/run python verification/fuzz.py --bodies --scenes 300 --alike 24 --resume bodies.csv
    docker/run python verification/fuzz.py --bodies --extreme --scenes 300 --resume extreme.csv
    docker/run python verification/fuzz.py --mixed --scenes 3000 --alike 48 --resume mixed.csv
    docker/run python verification/fuzz.py --replay scene.json --minimise
    docker/run python verification/fuzz.py --table results.csv        # Markdown

Outcomes: "right"; "another" (a solution other than the independent one, which friction permits);
"refused" (with class and category of the error); "wrong" (accepted, but not a solution); "crashed"
(an unexpected error); "slow" (time limit); "unjudged" (the independent solver failed). A refused
scene is solved again with each method of the package alone.

Batches of scenes are solved in separate processes, with `mpirun` for several ranks. A scene that
hangs or ends its process is recorded, and the next process continues after it.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import csv
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes.processes import command, subprocess_environment

__all__ = ["Outcome", "find_solving_method", "list_features", "make_table", "minimise", "run_scene"]

Scene = dict[str, Any]

OUTCOMES = ("right", "another", "refused", "wrong", "crashed", "slow", "unjudged")
FIELDS = ("seed", "ranks", "outcome", "kind", "increments", "seconds", "features", "detail", "by")
# Methods with which refused scenes are solved again, and their largest number of iterations.
METHODS = {"newton": 100, "continuation": 100, "primal_dual": 100, "lbfgs": 1000}
# Categories of refusals by words in the error text.
CATEGORIES = {
    "half of the radius": "too deep",
    "gone through Γc": "gone through",
    "cells are inverted": "inverted",
    "rad in one increment": "turned too far",
    "no contact force can balance": "load not balanced",
    "neither Dirichlet conditions nor contact constrain": "not held",
    "did not converge": "not converged",
    "does not pass the verification": "not converged",
    "penetrat": "penetration",
    "no potential": "no potential",
    "too large": "too large",
    "rigid": "rigid motion",
}
# Not empty if the time limit was exceeded, even if a library raises another error then.
_TIMED_OUT: list[bool] = []
# Checks of derived results, not of the equations.
_DERIVED_RESULTS = ("reported", "energy springs", "energy dissipation", "multipliers")
# Packages that compile forms, which the time limit does not interrupt.
_COMPILERS = ("ffcx", "cffi", "ufl")
# Number of scenes in one process.
_BATCH_SIZE = 120


@dataclass
class Outcome:
    """Outcome of a scene.

    Attributes:
        outcome: One of `OUTCOMES`.
        kind: Class and category of the error, or the failed checks.
        increments: Number of increments that were solved and compared.
        seconds: Time of both solvers.
        detail: Texts of errors and failed checks.
        error_ratios: By check, the largest ratio of error to tolerance.
        by: Method that solves a refused scene alone.
    """

    outcome: str
    kind: str
    increments: int
    seconds: float
    detail: list[str]
    error_ratios: dict[str, float]
    by: str = ""


# ---- one scene -----------------------------------------------------------------------------------


class _TimeLimitExceeded(BaseException):
    """The time limit is exceeded."""


@contextlib.contextmanager
def _time_limit(seconds: float | None) -> Iterator[None]:
    """Raise `_TimeLimitExceeded` after some processor time, but not during a compilation."""
    if not seconds:
        yield
        return

    def timed_out(_: int, frame: Any) -> None:
        if any(
            f"/{name}/" in s.filename for s in traceback.extract_stack(frame) for name in _COMPILERS
        ):
            # An interrupted compilation would block later ones by an incomplete form in the cache.
            signal.setitimer(signal.ITIMER_PROF, 0.5)
            return
        _TIMED_OUT.append(True)
        raise _TimeLimitExceeded

    _TIMED_OUT.clear()
    before = signal.signal(signal.SIGPROF, timed_out)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def _category(error: BaseException) -> str:
    text = str(error)
    for log, name in CATEGORIES.items():
        if log in text:
            return f"{type(error).__name__}: {name}"
    return f"{type(error).__name__}: {re.sub('[0-9.e+-]+', '#', text)[:60]}"


def _is_refusal(error: BaseException) -> bool:
    """Whether the error is raised by the package, not by a library."""
    import fenics_contact as fc

    if isinstance(error, fc.NotConverged):
        return True
    last = traceback.extract_tb(error.__traceback__)[-1]
    return isinstance(error, ValueError | TypeError) and "fenics_contact/" in last.filename


def run_scene(
    scene: Scene,
    comm: Any = None,
    *,
    limit: float | None = None,
    modify: Any = None,
    perturb: Callable[[dict[str, Any]], None] | None = None,
) -> Outcome:
    """Solve a scene with the package; on rank 0 compare it and return the outcome. Collective.

    Args:
        scene: The scene.
        comm: Communicator; by default of one rank.
        limit: Processor time for the package (s); without effect on several ranks.
        modify: Function that introduces an error, see `fuzz_setup.run_history`.
        perturb: Function that changes a record before its comparison (tests).
    """
    from mpi4py import MPI

    from verification import fuzz_comparison, fuzz_setup

    setup_class, comparison_class = fuzz_setup.SceneSetup, fuzz_comparison.Comparison
    if scene.get("kinematics") == "finite":
        from verification import finite_reference, finite_scenes

        setup_class, comparison_class = finite_scenes.FiniteSetup, finite_reference.FiniteComparison
    elif scene.get("kinematics") == "finite sliding":
        from verification import sliding_reference, sliding_scenes

        setup_class, comparison_class = (
            sliding_scenes.SlidingSetup,
            sliding_reference.SlidingComparison,
        )
    comm = comm or MPI.COMM_SELF
    records: list[dict[str, Any]] = []
    start, outcome, kind, detail = time.perf_counter(), "right", "", []
    try:
        with warnings.catch_warnings(), _time_limit(limit if comm.size == 1 else None):
            if comm.size == 1:  # on several ranks an error would be a deadlock
                warnings.simplefilter("error", RuntimeWarning)
            fuzz_setup.run_history(scene, comm, records.append, modify, setup_class)
    except _TimeLimitExceeded:
        outcome = "slow"
    except Exception as error:
        outcome = "refused" if _is_refusal(error) else "crashed"
        kind = _category(error)
        if _TIMED_OUT:  # PETSc may have raised another error
            outcome, kind = "slow", ""
        trace = traceback.extract_tb(error.__traceback__)[-1]
        detail = [str(error)[:500]]
        if outcome == "crashed":
            detail.append(f"{trace.filename}:{trace.lineno}")
    if comm.rank:
        return Outcome(outcome, kind, len(records), 0.0, [], {})
    error_ratios: dict[str, float] = {}
    try:
        with (
            warnings.catch_warnings(),
            _time_limit(3 * limit if limit and comm.size == 1 else None),
        ):
            warnings.simplefilter("ignore")
            if "unrelated_body" in scene:
                scene = {name: value for name, value in scene.items() if name != "unrelated_body"}
                for record in records:
                    del record["contacts"][len(scene["contacts"]) :]
                    record["energy"] = None
            comparison = comparison_class(scene) if records or outcome != "right" else None
            for record in records:
                if perturb is not None:
                    perturb(record)
                comparison.check_increment(record)
                if comparison.failed_checks:
                    break
            ahead = _next_load(scene, records)
            if (
                outcome in ("refused", "slow")
                and comparison is not None
                and not comparison.failed_checks
                and ahead
            ):
                kind += f" ({comparison.try_next_load(*ahead)})"
        if comparison is not None:
            error_ratios = comparison.error_ratios
            if comparison.failed_checks:
                outcome = "wrong"
                kind = ", ".join(sorted({w.split(":")[0] for w in comparison.failed_checks}))
                unpaired = any(c["unpaired"] for c in records[-1]["contacts"])
                if unpaired and all(
                    w.startswith(_DERIVED_RESULTS) for w in comparison.failed_checks
                ):
                    kind = "unpaired points: " + kind
                detail = comparison.failed_checks[:6]
            elif outcome == "right" and comparison.other_solutions:
                outcome, detail = "another", comparison.other_solutions[:3]
            detail = detail + comparison.not_compared[:2]
    except (_TimeLimitExceeded, Exception) as error:
        outcome, kind = "unjudged", type(error).__name__
        detail = traceback.format_exc().strip().splitlines()[-6:]
    return Outcome(outcome, kind, len(records), time.perf_counter() - start, detail, error_ratios)


def find_solving_method(scene: Scene, comm: Any = None, *, limit: float | None = None) -> str:
    """Return the first method that solves a refused scene alone, or "". Collective.

    Args:
        scene: The scene.
        comm: Communicator; by default of one rank.
        limit: Processor time (s), as for `run_scene`.
    """
    for method, most in METHODS.items():  # an iteration limit excludes the fallback
        found = run_scene(scene | {"method": method, "max_iterations": most}, comm, limit=limit)
        outcome = found.outcome if comm is None else comm.bcast(found.outcome)
        if outcome in ("right", "another"):
            return method
    return ""


def _next_load(scene: Scene, records: list[dict[str, Any]]) -> tuple[int, float] | None:
    """Return stage and load parameter of the next increment, or None after the last one."""
    from verification import fuzz_scenes

    last = (records[-1]["stage"], records[-1]["load"]) if records else (-1, 0.0)
    return next((p for p in fuzz_scenes.load_path(scene) if p > (last[0], last[1] + 1e-9)), None)


def list_features(scene: Scene) -> list[str]:
    """Return the features of a scene, for tables."""
    from verification import fuzz_features

    found = [scene["layout"], scene["cell"], f"degree {scene['degree']}", f"drive {scene['drive']}"]
    found += [f"{n} {scene[n]}" for n in ("bulk", "form") if n in scene]
    for contact in scene["contacts"]:
        obstacle = contact["obstacle"]
        found += [f"law {contact['law']['kind']}", f"obstacle {obstacle['kind']}"]
        found += [f"pairs {obstacle['update_pairs']}"] if "update_pairs" in obstacle else []
        found += (
            [f"moving by {obstacle['moving'].replace('translated', 'translation')}"]
            if "moving" in obstacle
            else []
        )
        found += [f"turning about {obstacle['turn']}"] if "turn" in obstacle else []
        found += [f"prescribed {n}" for n in ("gap",) if n in contact]
        found += [
            f"{n} {contact[n]}" for n in ("scheme", "enforcement", "accuracy") if n in contact
        ]
        found += [f"k by {contact['law'][k][0]}" for k in ("k_n", "k_t") if contact["law"].get(k)]
    found += [n for n in ("restart", "weight", "thickness", "bend") if n in scene]
    found += ["iteration limit"] * ("max_iterations" in scene)
    found += ["friction changes"] if any("friction" in s for s in scene["stages"]) else []
    sides = {(c["body"], c["side"]) for c in scene["contacts"]}
    opposite = {(c["obstacle"].get("body"), c["obstacle"].get("side")) for c in scene["contacts"]}
    found += ["both sides"] if sides & opposite else []
    found += [f"method {scene['method']}"] if "method" in scene else []
    found += ["units"] if scene["units"] != [1.0, 1.0] else []
    found += ["two scales"] if scene["load_ratio"] != 1.0 else []
    sizes = [s["normal"] for s in scene["stages"] if s["normal"] > 0]
    found += ["levels"] if sizes and max(sizes) > 50 * min(sizes) else []
    found += fuzz_features.feature_names(scene)
    found += _dissimilarities(scene) if scene.get("kinematics") == "finite sliding" else []
    found += ["off"] if any(s["normal"] <= 0 for s in scene["stages"]) else []
    return sorted(set(found))


def _dissimilarities(scene: Scene) -> list[str]:
    """Return the features of a Γc whose facet size differs by a factor of 4, or modulus by 1000."""
    own, other = (
        scene["bodies"][side["body"]]
        for side in (scene["contacts"][0], scene["contacts"][0]["obstacle"])
    )
    wide, stiff = (own["size"][0] / own["n"][0]) / (other["size"][0] / other["n"][0]), own["E"]
    found = [f"Γc {'coarse' if wide > 1 else 'fine'}"] * (not 0.25 < wide < 4)
    stiff /= other["E"]
    return found + [f"Γc {'stiff' if stiff > 1 else 'soft'}"] * (not 1e-3 < stiff < 1e3)


# ---- many scenes ---------------------------------------------------------------------------------


def _draw_scene(seed: int, arguments: argparse.Namespace, ranks: int) -> Scene:
    """Draw the scene of a seed; consecutive seeds may form a family."""
    from verification import finite_scenes, fuzz_features, fuzz_scenes, sliding_scenes

    family = seed // arguments.alike if arguments.alike > 1 else None
    options = {"without": tuple(arguments.without), "ranks": ranks, "family": family}
    if arguments.mixed:
        number, scene = seed if family is None else family, fuzz_scenes.draw
        # Expensive features are limited to some of the families.
        rare = {"space": number % 8 in (0, 5), "multipliers": number % 3 == 0}
        rare |= {"method": number % 2 == 0, "fine": False}
        if number % 8 in (2, 5) and seed % 2 == 0:
            scene = finite_scenes.draw
        elif number % 8 == 7 and seed % 4 == 0:
            scene = sliding_scenes.draw
            options["extreme"] = number % 16 == 7
        options["without"] += tuple(name for name, some in rare.items() if not some)
        return fuzz_features.add_features(scene(seed, **options), seed, options["without"])
    if arguments.bodies:
        return sliding_scenes.draw(seed, **options, extreme=arguments.extreme)
    return (finite_scenes if arguments.finite else fuzz_scenes).draw(seed, **options)


def _cache_forms() -> dict[Any, Any]:
    """Make FFCx load a form once per process, because it lists its whole cache folder each time.

    Returns:
        The loaded forms by name.
    """
    from ffcx.codegeneration import jit

    look_up, found = jit.get_cached_module, {}

    def cached(name: str, objects: Any, folder: Any, timeout: Any) -> Any:
        key = (name, str(folder))
        if key not in found:
            compiled, module = look_up(name, objects, folder, timeout)
            if module is None:  # not compiled yet
                return None, None
            found[key] = compiled, module
        return found[key]

    jit.get_cached_module = cached
    return found


def _run_batch(seeds: list[int], arguments: argparse.Namespace) -> None:
    """Run scenes in this process, and print each outcome as JSON on rank 0. Collective."""
    import gc

    from mpi4py import MPI

    forms = _cache_forms()
    comm = MPI.COMM_WORLD
    if comm.size > 1:
        gc.disable()  # destructors are collective
    for seed in seeds:
        scene = _draw_scene(seed, arguments, comm.size)
        if comm.rank == 0:
            print(json.dumps({"begins": seed}), flush=True)
        loaded = len(forms)
        outcome = run_scene(scene, comm if comm.size > 1 else None, limit=arguments.limit)
        if outcome.outcome == "slow" and comm.size == 1 and len(forms) > loaded:
            # Solved again, with compiled forms.
            outcome = run_scene(scene, None, limit=arguments.limit)
        refused = comm.bcast(outcome.outcome == "refused" and "NotConverged" in outcome.kind)
        if refused and "max_iterations" not in scene:
            several = comm if comm.size > 1 else None
            outcome.by = find_solving_method(scene, several, limit=arguments.limit)
        gc.collect()
        comm.barrier()
        if comm.rank == 0:
            print(json.dumps({"seed": seed} | vars(outcome)), flush=True)


def _start_batch(seeds: list[int], arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the outcomes of scenes solved in one process, until it ends or hangs."""
    log = ["--work", ",".join(map(str, seeds)), "--limit", arguments.limit]
    log += ["--alike", arguments.alike] + ["--finite"] * arguments.finite
    log += ["--bodies"] * arguments.bodies + ["--extreme"] * arguments.extreme
    log += ["--mixed"] * arguments.mixed
    log += [v for name in arguments.without for v in ("--without", name)]
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            command(arguments.ranks, __file__, *log),
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=subprocess_environment() | {"OMP_NUM_THREADS": "1"},
            start_new_session=True,
        )
        timed_out: list[bool] = []

        def end() -> None:
            timed_out.append(True)
            os.killpg(process.pid, signal.SIGKILL)

        begun = None
        assert process.stdout is not None
        patience = 10 * arguments.limit + 60  # with compilation
        watch = threading.Timer(patience, end)
        watch.start()
        try:
            for line in process.stdout:
                watch.cancel()
                watch = threading.Timer(patience, end)
                watch.start()
                try:
                    found = json.loads(line)
                except json.JSONDecodeError:
                    continue
                if "begins" in found:
                    begun = found["begins"]
                else:
                    yield found
                    begun = None
            process.wait()
        finally:
            watch.cancel()
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        if begun is not None:
            errors.seek(0)
            kind = "hangs" if timed_out else f"process ended with {process.returncode}"
            text = errors.read()[-1500:].splitlines()[-12:]
            outcome = Outcome("slow" if timed_out else "crashed", kind, 0, patience, text, {})
            yield {"seed": begun} | vars(outcome)


def run_campaign(arguments: argparse.Namespace) -> Counter[str]:
    """Run the scenes that are not yet in the file of results, and append their outcomes."""
    path = Path(arguments.resume)
    done = set()
    if path.exists():
        with path.open(newline="") as file:
            done = {int(row["seed"]) for row in csv.DictReader(file)}
    seeds = [s for s in range(arguments.start, arguments.start + arguments.scenes) if s not in done]
    counts: Counter[str] = Counter()
    lock = threading.Lock()

    def append_outcome(found: dict[str, Any]) -> None:
        scene = _draw_scene(found["seed"], arguments, arguments.ranks)
        row = {n: found.get(n) for n in FIELDS} | {
            "ranks": arguments.ranks,
            "features": "; ".join(list_features(scene)),
            "detail": " | ".join(found["detail"]),
            "seconds": f"{found['seconds']:.2f}",
        }
        with lock, path.open("a", newline="") as file:
            writer = csv.DictWriter(file, FIELDS)
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
        with lock:
            counts[found["outcome"]] += 1
            counts["refused, solved by a method alone"] += bool(found.get("by"))
            if found["outcome"] in ("wrong", "crashed", "unjudged") or arguments.verbose:
                detail = found["detail"][0] if found["detail"] else ""
                print(
                    f"{found['seed']}: {found['outcome']}: {found['kind']}: {detail}"[:300],
                    flush=True,
                )

    def worker(own: list[int]) -> None:
        while own:
            got = set()
            for found in _start_batch(own[:_BATCH_SIZE], arguments):
                append_outcome(found)
                got.add(found["seed"])
            if not got:
                raise RuntimeError(f"no scene of {own[:_BATCH_SIZE]} could be started")
            own = [s for s in own if s not in got]

    threads = [
        threading.Thread(target=worker, args=(seeds[i :: arguments.processes],))
        for i in range(arguments.processes)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(dict(counts))
    return counts


# ---- minimal scenes ------------------------------------------------------------------------------


def _simplifications(scene: Scene) -> Iterator[Scene]:
    """Yield simpler scenes, with one change each."""

    def modify(change: Callable[[Scene], Any]) -> Iterator[Scene]:
        other = copy.deepcopy(scene)
        change(other)
        if other != scene:
            yield other

    for name in (
        "restart",
        "max_iterations",
        "method",
        "condensation",
        "weight",
        "thickness",
        "form",
        "bend",
        "cuts",
        "unrelated_body",
        "translation",
    ):
        if name in scene:
            yield from modify(lambda s, n=name: s.pop(n))
    yield from modify(lambda s: s.update(units=[1.0, 1.0]))
    yield from modify(lambda s: s.update(load_ratio=1.0))
    n_stages = len(scene["stages"])
    for i in reversed(range(n_stages)):
        if n_stages > 1:
            yield from modify(lambda s, i=i: s["stages"].pop(i))
        yield from modify(lambda s, i=i: s["stages"][i].update(steps=1))
        yield from modify(lambda s, i=i: s["stages"][i].pop("friction", None))
        yield from modify(lambda s, i=i: s["stages"][i].update(across=0.0))
        yield from modify(lambda s, i=i: s["stages"][i].update(side=0.0, across=0.0))
        for n in ("normal", "side"):
            value = float(f"{scene['stages'][i][n]:.1g}")
            yield from modify(lambda s, i=i, n=n, v=value: s["stages"][i].update({n: v}))
    if len(scene["contacts"]) > 1 and scene["layout"] in ("corner", "pair"):
        yield from modify(lambda s: s["contacts"].pop())
    for i, contact in enumerate(scene["contacts"]):
        for name in ("gap", "scheme", "quadrature", "enforcement", "accuracy"):
            if name in contact:
                yield from modify(lambda s, i=i, n=name: s["contacts"][i].pop(n))
        law, obstacle = contact["law"], contact["obstacle"]
        yield from modify(
            lambda s, i=i: s["contacts"][i].update(
                law={"kind": "frictionless", "k_n": ["number", 10.0]}
            )
        )
        if law["kind"] not in ("frictionless", "coulomb"):
            simple = {
                "kind": "coulomb",
                "friction": 0.3,
                "k_n": ["number", 10.0],
                "k_t": ["number", 10.0],
            }
            yield from modify(lambda s, i=i, x=simple: s["contacts"][i].update(law=x))
        for k in ("k_n", "k_t"):
            if law.get(k):
                yield from modify(
                    lambda s, i=i, k=k: s["contacts"][i]["law"].update({k: ["number", 10.0]})
                )
        for name in ("slope", "moving"):
            if name in obstacle:
                yield from modify(lambda s, i=i, n=name: s["contacts"][i]["obstacle"].pop(n))
        if obstacle["kind"] != "body":
            plain = {n: v for n, v in obstacle.items() if n in ("moving", "free")}
            plain |= {"kind": "halfspace", "clearance": 0.0}
            yield from modify(lambda s, i=i, p=plain: s["contacts"][i].update(obstacle=p))
            yield from modify(lambda s, i=i: s["contacts"][i]["obstacle"].update(clearance=0.0))
        else:
            yield from modify(
                lambda s, i=i: s["contacts"][i]["obstacle"].update(update_pairs="never")
            )
    for b, body in enumerate(scene["bodies"]):
        yield from modify(lambda s, b=b: s["bodies"][b].update(jitter=0))
        yield from modify(lambda s, b=b: s["bodies"][b].update(E=1000.0))
        for i, n in enumerate(body["n"]):
            for fewer in {1, n - 1}:
                if 0 < fewer < n:
                    yield from modify(
                        lambda s, b=b, i=i, f=fewer: s["bodies"][b]["n"].__setitem__(i, f)
                    )
    for i in range(len(scene["dirichlet"])):
        yield from modify(lambda s, i=i: s["dirichlet"].pop(i))
    yield from modify(lambda s: s.update(degree=1))
    yield from modify(lambda s: s.update(nu=0.3))
    yield from modify(lambda s: s.update(strain=float(f"{s['strain']:.1g}")))
    if scene["cell"] == "triangle":
        yield from modify(lambda s: s.update(cell="quadrilateral"))
    if scene["cell"] == "tetrahedron":
        yield from modify(lambda s: s.update(cell="hexahedron"))


def minimise(
    scene: Scene, fails: Callable[[Scene], bool], *, seconds: float = 120.0, log: Any = None
) -> Scene:
    """Return a scene simplified step by step while ``fails`` remains true."""
    end = time.monotonic() + seconds
    going = True
    while going:
        going = False
        for simpler in _simplifications(scene):
            if time.monotonic() > end:
                return scene
            try:
                stays = fails(simpler)
            except Exception:
                stays = False
            if stays:
                scene, going = simpler, True
                if log:
                    log(f"simpler: {len(json.dumps(scene))} characters")
                break
    return scene


# ---- the table -----------------------------------------------------------------------------------


def _method_remark(row: dict[str, str]) -> str:
    """Return a remark on the method that solves a refused scene alone; empty in older files."""
    return f", solved by {row['by']}" if row.get("by") else ""


def make_table(paths: list[str]) -> str:
    """Return the outcomes by feature, and those not right by category, in Markdown."""
    rows = []
    for path in paths:
        with open(path, newline="") as file:
            rows += list(csv.DictReader(file))
    by_feature: dict[str, Counter[str]] = {"all": Counter()}
    for row in rows:
        for name in ["all", f"ranks {row['ranks']}", *row["features"].split("; ")]:
            by_feature.setdefault(name, Counter())[row["outcome"]] += 1
    lines = [
        f"{len(rows)} scenes, {sum(int(r['increments']) for r in rows)} increments compared.",
        "",
    ]
    lines += ["| feature | scenes | " + " | ".join(OUTCOMES) + " |"]
    lines += ["|---|" + "---|" * (1 + len(OUTCOMES))]
    for name in ["all", *sorted(set(by_feature) - {"all"})]:
        counts = by_feature[name]
        cells = [str(counts[o] or "–") for o in OUTCOMES]
        lines.append(f"| {name} | {counts.total()} | " + " | ".join(cells) + " |")
    lines += ["", "| outcome | why | scenes |", "|---|---|---|"]
    why = Counter(
        (r["outcome"], f"{r['kind']}{_method_remark(r)}")
        for r in rows
        if r["outcome"] not in ("right", "another")
    )
    lines += [f"| {o} | {k or '–'} | {n} |" for (o, k), n in why.most_common()]
    return "\n".join(lines)


def main() -> int:
    """Run the command; the exit code is 1 if a scene is wrong or crashed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, help="run one scene")
    parser.add_argument("--replay", help="run the scene in a JSON file")
    parser.add_argument("--minimise", action="store_true", help="reduce a scene that fails")
    parser.add_argument("--scenes", type=int, default=100, help="number of scenes")
    parser.add_argument("--start", type=int, default=0, help="first seed")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument(
        "--limit", type=float, default=10.0, help="processor seconds for the package"
    )
    parser.add_argument("--resume", default="fuzz.csv", help="file of results, appended to")
    parser.add_argument("--without", action="append", default=[], help="a feature to exclude")
    parser.add_argument(
        "--alike", type=int, default=1, help="number of consecutive scenes with common forms"
    )
    parser.add_argument("--finite", action="store_true", help="finite kinematics, rigid obstacles")
    parser.add_argument("--bodies", action="store_true", help="finite kinematics, two bodies")
    parser.add_argument("--extreme", action="store_true", help="dissimilar bodies, with --bodies")
    parser.add_argument(
        "--mixed", action="store_true", help="scenes of all three kinds, with additional features"
    )
    parser.add_argument("--table", nargs="+", help="print a table of files of results")
    parser.add_argument("--verbose", action="store_true", help="print a line for every scene")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.table:
        print(make_table(arguments.table))
        return 0
    if arguments.work:
        _run_batch([int(s) for s in arguments.work.split(",")], arguments)
        return 0
    if arguments.seed is None and arguments.replay is None:
        counts = run_campaign(arguments)
        return int(counts["wrong"] + counts["crashed"] > 0)

    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    if arguments.replay:
        scene = json.loads(Path(arguments.replay).read_text())
    else:
        scene = _draw_scene(arguments.seed, arguments, comm.size)
    outcome = run_scene(scene, comm if comm.size > 1 else None, limit=None)
    bad = outcome.outcome in ("wrong", "crashed", "unjudged")
    if arguments.minimise and bad and comm.size == 1:

        def fails(other: Scene) -> bool:
            found = run_scene(other, limit=arguments.limit)
            same = set(found.kind.split(", ")) & set(outcome.kind.split(", "))
            return found.outcome == outcome.outcome and bool(same)

        scene = minimise(scene, fails, log=lambda text: print(text, file=sys.stderr))
        outcome = run_scene(scene)
    if comm.rank == 0:
        print(json.dumps(scene))
        print(f"{outcome.outcome}: {outcome.kind} ({outcome.increments} increments)")
        print(*outcome.detail, sep="\n")
        print({k: float(f"{v:.2g}") for k, v in outcome.error_ratios.items()})
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
