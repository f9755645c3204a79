"""Random scenes, each compared with a second solution: does anything come out silently wrong?

    docker/run python verification/fuzz.py --seed 17                  # one scene, in words
    docker/run python verification/fuzz.py --scenes 1000 --resume results.csv
    docker/run python verification/fuzz.py --scenes 200 --ranks 2 --resume results2.csv
    docker/run python verification/fuzz.py --scenes 9000 --alike 12 --resume more.csv  # faster
    docker/run python verification/fuzz.py --finite --scenes 300 --alike 12 --resume finite.csv
    docker/run python verification/fuzz.py --bodies --scenes 300 --alike 24 --resume bodies.csv
    docker/run python verification/fuzz.py --bodies --extreme --scenes 300 --resume extreme.csv
    docker/run python verification/fuzz.py --mixed --scenes 3000 --alike 48 --resume mixed.csv
    docker/run python verification/fuzz.py --replay scene.json --minimise
    docker/run python verification/fuzz.py --table results.csv        # Markdown

Outcomes: "right" (and "another": right by its equations, but not the solution found apart, where
friction leaves several), "refused" (with the error's class and what it says), "wrong" (the
package said it is solved and it is not), "crashed" (an error that is no refusal), "slow", and
"unjudged" (the judge itself failed). What is refused is tried by each of the package's methods
alone: one that solves it contradicts the refusal, which then is a fault of the choice between them.

Scenes are solved in processes of their own, many in one: `mpirun` for several ranks. One that hangs
or dies is noted, and the next process goes on behind it.
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

from scenes.processes import command, environment

__all__ = ["Outcome", "contradicted", "features", "minimise", "play", "table"]

Scene = dict[str, Any]

OUTCOMES = ("right", "another", "refused", "wrong", "crashed", "slow", "unjudged")
FIELDS = ("seed", "ranks", "outcome", "kind", "increments", "seconds", "features", "detail", "by")
# Methods of the package that are tried alone on what it refuses, and their iterations at most.
METHODS = {"newton": 100, "continuation": 100, "primal_dual": 100, "lbfgs": 1000}
# What refusals say, by what they are about.
CATEGORIES = {
    "half of the radius": "too deep",
    "gone through Γc": "gone through",
    "cells are inverted": "inverted",
    "rad in one increment": "turned too far",
    "no contact force can balance": "load not balanced",
    "neither Dirichlet conditions nor contact constrain": "not held",
    "did not converge": "not converged",
    "penetrat": "penetration",
    "no potential": "no potential",
    "too large": "too large",
    "rigid": "rigid motion",
}
# Whether the time was up, even if the error that came of it is another.
_LATE: list[bool] = []
# What is made of the fields at the points, apart from the equations.
_REPORTED = ("reported", "energy springs", "energy dissipation", "multipliers")
# Packages that compile forms.
_JIT = ("ffcx", "cffi", "ufl")
# Scenes in one process.
_BATCH = 120


@dataclass
class Outcome:
    """What became of a scene.

    Attributes:
        outcome: One of `OUTCOMES`.
        kind: Of a refusal its class and category; of what is wrong the checks that failed.
        increments: Number of increments that were solved and judged.
        seconds: For the package and the judge.
        detail: In words.
        worst: Largest figure of every check, in units of what is allowed.
        by: Of what is refused, though a method of the package solves it alone: that method's name.
    """

    outcome: str
    kind: str
    increments: int
    seconds: float
    detail: list[str]
    worst: dict[str, float]
    by: str = ""


# ---- one scene -----------------------------------------------------------------------------------


class _Slow(BaseException):
    """The time is up."""


@contextlib.contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """Raise `_Slow` in the block when its processor time is up; of one rank only.

    That leaves out what compilers take.
    """
    if not seconds:
        yield
        return

    def late(_: int, frame: Any) -> None:
        if any(f"/{name}/" in s.filename for s in traceback.extract_stack(frame) for name in _JIT):
            # Half a compiled form would stop all later ones that want it.
            signal.setitimer(signal.ITIMER_PROF, 0.5)
            return
        _LATE.append(True)
        raise _Slow

    _LATE.clear()
    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def _category(error: BaseException) -> str:
    text = str(error)
    for words, name in CATEGORIES.items():
        if words in text:
            return f"{type(error).__name__}: {name}"
    return f"{type(error).__name__}: {re.sub('[0-9.e+-]+', '#', text)[:60]}"


def _is_refusal(error: BaseException) -> bool:
    """Whether the package says so itself, and not something below it."""
    import fenics_contact as fc

    if isinstance(error, fc.NotConverged):
        return True
    last = traceback.extract_tb(error.__traceback__)[-1]
    return isinstance(error, ValueError | TypeError) and "fenics_contact/" in last.filename


def play(
    scene: Scene,
    comm: Any = None,
    *,
    limit: float | None = None,
    changed: Any = None,
    spoiled: Callable[[dict[str, Any]], None] | None = None,
) -> Outcome:
    """Solve a scene by the package and judge it; the outcome is that of rank 0. Collective.

    Args:
        scene: The scene.
        comm: Ranks; by default one alone.
        limit: Processor seconds for the package, on one rank.
        changed: See `fuzz_made.history`.
        spoiled: Changes a record before it is judged, to show that the judge sees it.
    """
    from mpi4py import MPI

    from verification import fuzz_judge, fuzz_made

    make_scene, make_judge = fuzz_made.Made, fuzz_judge.Judge
    if scene.get("kinematics") == "finite":
        from verification import finite_reference, finite_scenes

        make_scene, make_judge = finite_scenes.FiniteMade, finite_reference.FiniteJudge
    elif scene.get("kinematics") == "present":
        from verification import present_reference, present_scenes

        make_scene, make_judge = present_scenes.PresentMade, present_reference.PresentJudge
    comm = comm or MPI.COMM_SELF
    records: list[dict[str, Any]] = []
    start, outcome, kind, detail = time.perf_counter(), "right", "", []
    try:
        with warnings.catch_warnings(), _limited(limit if comm.size == 1 else None):
            if comm.size == 1:  # on one rank of several it would leave the others waiting
                warnings.simplefilter("error", RuntimeWarning)
            fuzz_made.history(scene, comm, records.append, changed, make_scene)
    except _Slow:
        outcome = "slow"
    except Exception as error:
        outcome = "refused" if _is_refusal(error) else "crashed"
        kind = _category(error)
        if _LATE:  # inside PETSc it comes out as PETSc's error
            outcome, kind = "slow", ""
        trace = traceback.extract_tb(error.__traceback__)[-1]
        detail = [str(error)[:500]]
        if outcome == "crashed":
            detail.append(f"{trace.filename}:{trace.lineno}")
    if comm.rank:
        return Outcome(outcome, kind, len(records), 0.0, [], {})
    worst: dict[str, float] = {}
    try:
        with warnings.catch_warnings(), _limited(3 * limit if limit and comm.size == 1 else None):
            warnings.simplefilter("ignore")
            if "busy" in scene:  # the second solution knows nothing of the unrelated body
                scene = {name: value for name, value in scene.items() if name != "busy"}
                for record in records:
                    del record["contacts"][len(scene["contacts"]) :]
                    record["energy"] = None
            judge = make_judge(scene) if records or outcome != "right" else None
            for record in records:
                if spoiled is not None:
                    spoiled(record)
                judge.take(record)
                if judge.wrong:
                    break
            ahead = _ahead(scene, records)
            if outcome in ("refused", "slow") and judge is not None and not judge.wrong and ahead:
                kind += f" ({judge.look_ahead(*ahead)})"
        if judge is not None:
            worst = judge.worst
            if judge.wrong:
                outcome = "wrong"
                kind = ", ".join(sorted({w.split(":")[0] for w in judge.wrong}))
                unpaired = any(c["unpaired"] for c in records[-1]["contacts"])
                if unpaired and all(w.startswith(_REPORTED) for w in judge.wrong):
                    kind = "unpaired points: " + kind
                detail = judge.wrong[:6]
            elif outcome == "right" and judge.another:
                outcome, detail = "another", judge.another[:3]
            detail = detail + judge.unjudged[:2]
    except (_Slow, Exception) as error:
        outcome, kind = "unjudged", type(error).__name__
        detail = traceback.format_exc().strip().splitlines()[-6:]
    return Outcome(outcome, kind, len(records), time.perf_counter() - start, detail, worst)


def contradicted(scene: Scene, comm: Any = None, *, limit: float | None = None) -> str:
    """The first method that alone solves a scene, and rightly; empty if none does. Collective.

    Args:
        scene: A scene that is refused.
        comm: Ranks; by default one alone.
        limit: As for `play`.
    """
    for method, most in METHODS.items():  # no other method takes over where iterations are rationed
        found = play(scene | {"method": method, "ration": most}, comm, limit=limit)
        outcome = found.outcome if comm is None else comm.bcast(found.outcome)
        if outcome in ("right", "another"):
            return method
    return ""


def _ahead(scene: Scene, records: list[dict[str, Any]]) -> tuple[int, float] | None:
    """Stage and load parameter of the next increment that was asked for."""
    from verification import fuzz_scenes

    last = (records[-1]["stage"], records[-1]["load"]) if records else (-1, 0.0)
    return next((p for p in fuzz_scenes.path(scene) if p > (last[0], last[1] + 1e-9)), None)


def features(scene: Scene) -> list[str]:
    """What a scene has, for tables."""
    from verification import fuzz_features

    found = [scene["layout"], scene["cell"], f"degree {scene['degree']}", f"drive {scene['drive']}"]
    found += [f"{n} {scene[n]}" for n in ("bulk", "form") if n in scene]
    for contact in scene["contacts"]:
        obstacle = contact["obstacle"]
        found += [f"law {contact['law']['kind']}", f"obstacle {obstacle['kind']}"]
        found += [f"pairs {obstacle['update']}"] if "update" in obstacle else []
        found += [f"moving by {obstacle['moving']}"] if "moving" in obstacle else []
        found += [f"turning about {obstacle['turn']}"] if "turn" in obstacle else []
        found += [f"prescribed {n}" for n in ("gap",) if n in contact]
        found += [
            f"{n} {contact[n]}" for n in ("scheme", "enforcement", "accuracy") if n in contact
        ]
        found += [f"k by {contact['law'][k][0]}" for k in ("k_n", "k_t") if contact["law"].get(k)]
    found += [n for n in ("restart", "ration", "weight", "thickness", "bend") if n in scene]
    found += ["friction changes"] if any("friction" in s for s in scene["stages"]) else []
    sides = {(c["body"], c["side"]) for c in scene["contacts"]}
    opposite = {(c["obstacle"].get("body"), c["obstacle"].get("side")) for c in scene["contacts"]}
    found += ["both sides"] if sides & opposite else []
    found += [f"method {scene['method']}"] if "method" in scene else []
    found += ["units"] if scene["units"] != [1.0, 1.0] else []
    found += ["two scales"] if scene["share"] != 1.0 else []
    sizes = [s["normal"] for s in scene["stages"] if s["normal"] > 0]
    found += ["levels"] if sizes and max(sizes) > 50 * min(sizes) else []
    found += fuzz_features.feature_names(scene)
    found += _unlikeness(scene) if scene.get("kinematics") == "present" else []
    found += ["off"] if any(s["normal"] <= 0 for s in scene["stages"]) else []
    return sorted(set(found))


def _unlikeness(scene: Scene) -> list[str]:
    """Of two bodies: which has facets at least four times as wide, or is 1000 times as stiff."""
    own, other = (
        scene["bodies"][side["body"]]
        for side in (scene["contacts"][0], scene["contacts"][0]["obstacle"])
    )
    wide, stiff = (own["size"][0] / own["n"][0]) / (other["size"][0] / other["n"][0]), own["E"]
    found = [f"Γc {'coarse' if wide > 1 else 'fine'}"] * (not 0.25 < wide < 4)
    stiff /= other["E"]
    return found + [f"Γc {'stiff' if stiff > 1 else 'soft'}"] * (not 1e-3 < stiff < 1e3)


# ---- many scenes ---------------------------------------------------------------------------------


def _drawn(seed: int, arguments: argparse.Namespace, ranks: int) -> Scene:
    """The scene of a seed, in a family with the other seeds next to it, if so asked."""
    from verification import finite_scenes, fuzz_features, fuzz_scenes, present_scenes

    family = seed // arguments.alike if arguments.alike > 1 else None
    options = {"without": tuple(arguments.without), "ranks": ranks, "family": family}
    if arguments.mixed:
        number, scene = seed if family is None else family, fuzz_scenes.draw
        # What takes longest is in some of the families alone, and in a part of these.
        rare = {"space": number % 8 in (0, 5), "multipliers": number % 3 == 0}
        rare |= {"method": number % 2 == 0, "fine": False}
        if number % 8 in (2, 5) and seed % 2 == 0:
            scene = finite_scenes.draw
        elif number % 8 == 7 and seed % 4 == 0:
            scene = present_scenes.draw
            options["extreme"] = number % 16 == 7
        options["without"] += tuple(name for name, some in rare.items() if not some)
        return fuzz_features.add_features(scene(seed, **options), seed, options["without"])
    if arguments.bodies:
        return present_scenes.draw(seed, **options, extreme=arguments.extreme)
    return (finite_scenes if arguments.finite else fuzz_scenes).draw(seed, **options)


def _keep_forms() -> dict[Any, Any]:
    """Load a compiled form once in this process: FFCx reads all of its folder every time.

    Returns:
        The forms loaded so far, by their names.
    """
    from ffcx.codegeneration import jit

    look_up, found = jit.get_cached_module, {}

    def kept(name: str, objects: Any, folder: Any, timeout: Any) -> Any:
        key = (name, str(folder))
        if key not in found:
            compiled, module = look_up(name, objects, folder, timeout)
            if module is None:  # to be compiled now
                return None, None
            found[key] = compiled, module
        return found[key]

    jit.get_cached_module = kept
    return found


def _work(seeds: list[int], arguments: argparse.Namespace) -> None:
    """In a process of its own, on all its ranks: play scenes, a line for each on rank 0."""
    import gc

    from mpi4py import MPI

    forms = _keep_forms()
    comm = MPI.COMM_WORLD
    if comm.size > 1:
        gc.disable()  # destructors are collective: together, between scenes
    for seed in seeds:
        scene = _drawn(seed, arguments, comm.size)
        if comm.rank == 0:
            print(json.dumps({"begins": seed}), flush=True)
        loaded = len(forms)
        outcome = play(scene, comm if comm.size > 1 else None, limit=arguments.limit)
        if outcome.outcome == "slow" and comm.size == 1 and len(forms) > loaded:
            # They were compiled or loaded meanwhile.
            outcome = play(scene, None, limit=arguments.limit)
        refused = comm.bcast(outcome.outcome == "refused" and "NotConverged" in outcome.kind)
        if refused and "ration" not in scene:
            several = comm if comm.size > 1 else None
            outcome.by = contradicted(scene, several, limit=arguments.limit)
        gc.collect()
        comm.barrier()
        if comm.rank == 0:
            print(json.dumps({"seed": seed} | vars(outcome)), flush=True)


def _batch(seeds: list[int], arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Results of scenes solved in one process; ends early where it hangs or dies."""
    words = ["--work", ",".join(map(str, seeds)), "--limit", arguments.limit]
    words += ["--alike", arguments.alike] + ["--finite"] * arguments.finite
    words += ["--bodies"] * arguments.bodies + ["--extreme"] * arguments.extreme
    words += ["--mixed"] * arguments.mixed
    words += [v for name in arguments.without for v in ("--without", name)]
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            command(arguments.ranks, __file__, *words),
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environment() | {"OMP_NUM_THREADS": "1"},
            start_new_session=True,
        )
        late: list[bool] = []

        def end() -> None:
            late.append(True)
            os.killpg(process.pid, signal.SIGKILL)

        begun = None
        assert process.stdout is not None
        patience = 10 * arguments.limit + 60  # compiling included
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
            kind = "hangs" if late else f"process ended with {process.returncode}"
            text = errors.read()[-1500:].splitlines()[-12:]
            outcome = Outcome("slow" if late else "crashed", kind, 0, patience, text, {})
            yield {"seed": begun} | vars(outcome)


def run(arguments: argparse.Namespace) -> Counter[str]:
    """Play scenes that are not in the file of results yet, and add them."""
    path = Path(arguments.resume)
    done = set()
    if path.exists():
        with path.open(newline="") as file:
            done = {int(row["seed"]) for row in csv.DictReader(file)}
    seeds = [s for s in range(arguments.start, arguments.start + arguments.scenes) if s not in done]
    counts: Counter[str] = Counter()
    lock = threading.Lock()

    def note(found: dict[str, Any]) -> None:
        scene = _drawn(found["seed"], arguments, arguments.ranks)
        row = {n: found.get(n) for n in FIELDS} | {
            "ranks": arguments.ranks,
            "features": "; ".join(features(scene)),
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
            for found in _batch(own[:_BATCH], arguments):
                note(found)
                got.add(found["seed"])
            if not got:
                raise RuntimeError(f"no scene of {own[:_BATCH]} could be started")
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


# ---- the shortest scene that fails ---------------------------------------------------------------


def _simpler(scene: Scene) -> Iterator[Scene]:
    """Scenes with one feature less."""

    def changed(change: Callable[[Scene], Any]) -> Iterator[Scene]:
        other = copy.deepcopy(scene)
        change(other)
        if other != scene:
            yield other

    for name in (
        "restart",
        "ration",
        "method",
        "condensation",
        "weight",
        "thickness",
        "form",
        "bend",
        "cuts",
        "busy",
        "carry",
    ):
        if name in scene:
            yield from changed(lambda s, n=name: s.pop(n))
    yield from changed(lambda s: s.update(units=[1.0, 1.0]))
    yield from changed(lambda s: s.update(share=1.0))
    n_stages = len(scene["stages"])
    for i in reversed(range(n_stages)):
        if n_stages > 1:
            yield from changed(lambda s, i=i: s["stages"].pop(i))
        yield from changed(lambda s, i=i: s["stages"][i].update(steps=1))
        yield from changed(lambda s, i=i: s["stages"][i].pop("friction", None))
        yield from changed(lambda s, i=i: s["stages"][i].update(across=0.0))
        yield from changed(lambda s, i=i: s["stages"][i].update(side=0.0, across=0.0))
        for n in ("normal", "side"):
            value = float(f"{scene['stages'][i][n]:.1g}")
            yield from changed(lambda s, i=i, n=n, v=value: s["stages"][i].update({n: v}))
    if len(scene["contacts"]) > 1 and scene["layout"] in ("corner", "pair"):
        yield from changed(lambda s: s["contacts"].pop())
    for i, contact in enumerate(scene["contacts"]):
        for name in ("gap", "scheme", "quadrature", "enforcement", "accuracy"):
            if name in contact:
                yield from changed(lambda s, i=i, n=name: s["contacts"][i].pop(n))
        law, obstacle = contact["law"], contact["obstacle"]
        yield from changed(
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
            yield from changed(lambda s, i=i, x=simple: s["contacts"][i].update(law=x))
        for k in ("k_n", "k_t"):
            if law.get(k):
                yield from changed(
                    lambda s, i=i, k=k: s["contacts"][i]["law"].update({k: ["number", 10.0]})
                )
        for name in ("slope", "moving"):
            if name in obstacle:
                yield from changed(lambda s, i=i, n=name: s["contacts"][i]["obstacle"].pop(n))
        if obstacle["kind"] != "body":
            plain = {n: v for n, v in obstacle.items() if n in ("moving", "free")}
            plain |= {"kind": "halfspace", "clearance": 0.0}
            yield from changed(lambda s, i=i, p=plain: s["contacts"][i].update(obstacle=p))
            yield from changed(lambda s, i=i: s["contacts"][i]["obstacle"].update(clearance=0.0))
        else:
            yield from changed(lambda s, i=i: s["contacts"][i]["obstacle"].update(update="never"))
    for b, body in enumerate(scene["bodies"]):
        yield from changed(lambda s, b=b: s["bodies"][b].update(jitter=0))
        yield from changed(lambda s, b=b: s["bodies"][b].update(E=1000.0))
        for i, n in enumerate(body["n"]):
            for fewer in {1, n - 1}:
                if 0 < fewer < n:
                    yield from changed(
                        lambda s, b=b, i=i, f=fewer: s["bodies"][b]["n"].__setitem__(i, f)
                    )
    for i in range(len(scene["holds"])):
        yield from changed(lambda s, i=i: s["holds"].pop(i))
    yield from changed(lambda s: s.update(degree=1))
    yield from changed(lambda s: s.update(nu=0.3))
    yield from changed(lambda s: s.update(strain=float(f"{s['strain']:.1g}")))
    if scene["cell"] == "triangle":
        yield from changed(lambda s: s.update(cell="quadrilateral"))
    if scene["cell"] == "tetrahedron":
        yield from changed(lambda s: s.update(cell="hexahedron"))


def minimise(
    scene: Scene, fails: Callable[[Scene], bool], *, seconds: float = 120.0, words: Any = None
) -> Scene:
    """Drop features one at a time while ``fails`` stays true, until none can go."""
    end = time.monotonic() + seconds
    going = True
    while going:
        going = False
        for simpler in _simpler(scene):
            if time.monotonic() > end:
                return scene
            try:
                stays = fails(simpler)
            except Exception:
                stays = False
            if stays:
                scene, going = simpler, True
                if words:
                    words(f"simpler: {len(json.dumps(scene))} characters")
                break
    return scene


# ---- the table -----------------------------------------------------------------------------------


def _by(row: dict[str, str]) -> str:
    """What solves alone what is refused, for a table; files of earlier runs do not say."""
    return f", though {row['by']} alone solves it" if row.get("by") else ""


def table(paths: list[str]) -> str:
    """Outcomes by feature and refusals by category, as Markdown."""
    rows = []
    for path in paths:
        with open(path, newline="") as file:
            rows += list(csv.DictReader(file))
    by_feature: dict[str, Counter[str]] = {"all": Counter()}
    for row in rows:
        for name in ["all", f"ranks {row['ranks']}", *row["features"].split("; ")]:
            by_feature.setdefault(name, Counter())[row["outcome"]] += 1
    lines = [
        f"{len(rows)} scenes, {sum(int(r['increments']) for r in rows)} increments judged.",
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
        (r["outcome"], f"{r['kind']}{_by(r)}")
        for r in rows
        if r["outcome"] not in ("right", "another")
    )
    lines += [f"| {o} | {k or '–'} | {n} |" for (o, k), n in why.most_common()]
    return "\n".join(lines)


def main() -> int:
    """The command; ends with 1 where something is wrong or crashed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, help="play one scene and tell")
    parser.add_argument("--replay", help="play the scene in a JSON file and tell")
    parser.add_argument(
        "--minimise", action="store_true", help="find the shortest that fails alike"
    )
    parser.add_argument("--scenes", type=int, default=100, help="how many")
    parser.add_argument("--start", type=int, default=0, help="first seed")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument(
        "--limit", type=float, default=10.0, help="processor seconds for the package"
    )
    parser.add_argument("--resume", default="fuzz.csv", help="file of results, added to")
    parser.add_argument("--without", action="append", default=[], help="a feature to leave out")
    parser.add_argument(
        "--alike", type=int, default=1, help="so many scenes in a row share their forms"
    )
    parser.add_argument(
        "--finite", action="store_true", help="scenes with finite kinematics; seeds of their own"
    )
    parser.add_argument(
        "--bodies", action="store_true", help="of two bodies with finite kinematics; likewise"
    )
    parser.add_argument(
        "--extreme", action="store_true", help="bodies as unlike as can be; with --bodies"
    )
    parser.add_argument(
        "--mixed", action="store_true", help="scenes of all three kinds, with additional features"
    )
    parser.add_argument("--table", nargs="+", help="print the table of files of results")
    parser.add_argument("--verbose", action="store_true", help="a line for every scene")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(arguments.table))
        return 0
    if arguments.work:
        _work([int(s) for s in arguments.work.split(",")], arguments)
        return 0
    if arguments.seed is None and arguments.replay is None:
        counts = run(arguments)
        return int(counts["wrong"] + counts["crashed"] > 0)

    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    if arguments.replay:
        scene = json.loads(Path(arguments.replay).read_text())
    else:
        scene = _drawn(arguments.seed, arguments, comm.size)
    outcome = play(scene, comm if comm.size > 1 else None, limit=None)
    bad = outcome.outcome in ("wrong", "crashed", "unjudged")
    if arguments.minimise and bad and comm.size == 1:

        def fails(other: Scene) -> bool:
            found = play(other, limit=arguments.limit)
            same = set(found.kind.split(", ")) & set(outcome.kind.split(", "))
            return found.outcome == outcome.outcome and bool(same)

        scene = minimise(scene, fails, words=lambda text: print(text, file=sys.stderr))
        outcome = play(scene)
    if comm.rank == 0:
        print(json.dumps(scene))
        print(f"{outcome.outcome}: {outcome.kind} ({outcome.increments} increments)")
        print(*outcome.detail, sep="\n")
        print({k: float(f"{v:.2g}") for k, v in outcome.worst.items()})
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
