"""Diagnoses of machines with effects concealed in them: how often they are named, refused, or falsely found."""

from __future__ import annotations

import functools
import json
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import mujoco
import numpy as np

from bayessim_jax.concealment import LAWS, UNKNOWN, StrengthError
from bayessim_jax.recordings.concealing import NOTHING, AbsorbedError
from benchmarks.compilation import make_room
from benchmarks.worlds import MODELS, RIGS, make_case

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from bayessim_jax.recordings.diagnosing import CaseDiagnosis

__all__ = [
    "GROUPS",
    "diagnose_all",
    "diagnose_concealed",
    "diagnose_drawn",
    "draw_cases",
    "judge",
    "make_drawn",
    "read_rows",
    "resumed",
    "summarize",
    "tabulate",
]

GROUPS = {"single": 0.37, "weak": 0.1, "pair": 0.1, "unknown": 0.18, "clean": 0.25}
"""Shares of the cases: one effect, one weak effect, two, one of no library, none."""
STRONG = 0.1
"""Least strength, but of weak effects."""
STRENGTHS = dict.fromkeys(GROUPS, (STRONG, 0.6)) | {"weak": (0.02, STRONG)}
"""Log-uniform between these."""
NOISE = (0.3, 1.0, 3.0)
ONE_LAW = (
    {"coulomb_friction", "stribeck_friction"},
    {"coulomb_friction", "asymmetric_friction", "actuator_bias"},
    {"coulomb_friction", "load_dependent_friction"},
    {"viscous_friction", "back_emf"},
    {"base_tilt", "sensor_offset", "link_offset"},
    {"armature", "payload", "link_offset"},
)
"""Effects of which two at one joint are one of them, or a third, with other numbers: no pairs."""
ATTEMPTS = 5
FINER = 4
"""Times that machines take shorter time steps than `bayessim conceal` does: 1/16 of the model's own."""


@functools.cache
def _compiled(rig: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(RIGS[rig].xml)


def _fits(effects: list[str], rig: str) -> bool:
    return all(LAWS[name].places(_compiled(rig)) for name in effects)


def draw_cases(rigs: list[str], count: int, seed: int, finer: int = FINER) -> list[dict[str, Any]]:
    """A stated random set, every effect in it about as often as every other; machines as in `worlds.make_case`."""
    rng = np.random.default_rng(seed)
    possible = [name for name in sorted(LAWS) if any(_fits([name], rig) for rig in rigs)]
    library = [name for name in possible if not name.startswith(UNKNOWN)]
    others = [name for name in possible if name.startswith(UNKNOWN)]
    decks: dict[str, list[str]] = {}

    def deal(deck: str, names: list[str]) -> str:
        if not decks.get(deck):
            decks[deck] = [str(name) for name in rng.permutation(names)]
        return decks[deck].pop()

    groups = [group for group, share in GROUPS.items() for _ in range(round(share * count))]
    groups = [str(g) for g in rng.permutation([*groups, *["single"] * count][:count])]
    cases = []
    for index, group in enumerate(groups):
        effects = [deal(group, others if group == "unknown" else library)] if group != "clean" else []
        fitting = [rig for rig in rigs if _fits(effects, rig)]
        rig = str(fitting[int(rng.integers(len(fitting)))])
        if group == "pair":
            one = set().union(*(law for law in ONE_LAW if effects[0] in law))
            second = [name for name in library if name not in {effects[0], *one} and _fits([name], rig)]
            effects.append(str(rng.choice(second)))
        low, high = STRENGTHS[group]
        cases.append(
            {
                "rig": rig,
                "group": group,
                "effects": effects,
                "strength": round(float(np.exp(rng.uniform(np.log(low), np.log(high)))), 3),
                "noise": float(rng.choice(NOISE)),
                "velocities": bool(rng.uniform() < 0.7),
                "quantize": float(rng.choice([2048.0, 8192.0, 32768.0])) if rng.uniform() < 0.15 else None,
                "jitter": 0.3 if rng.uniform() < 0.15 else 0.0,
                "finer": finer,
                "seed": seed * 100_000 + index,
            }
        )
    return cases


def make_drawn(folder: Path, case: dict[str, Any]) -> dict[str, Any]:
    """Write a case that was drawn; returns what is sealed.

    An effect that cannot be as strong as that comes nearly as strong as it can, or elsewhere; so does one that would
    only move what is unknown.
    """
    settings = {k: case[k] for k in ("noise", "velocities", "quantize", "jitter", "finer") if k in case}
    told: StrengthError | AbsorbedError | None = None
    for attempt in range(ATTEMPTS):
        asked = case["strength"]
        for _ in range(2):
            try:
                seed = case["seed"] + 10_000_000 * attempt
                return make_case(folder, case["rig"], case["effects"], strength=asked, seed=seed, **settings)
            except StrengthError as error:
                told, asked = error, 0.9 * error.most
                if asked < STRENGTHS[case["group"]][0]:
                    break
            except AbsorbedError as error:
                told = error
                break
    assert told is not None
    raise told


def _bare(name: str) -> str:
    """Effect and place without what follows a `#`."""
    return name.partition("#")[0]


def _hidden(sealed: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What is sealed of every effect, by its bare name."""
    return {_bare(f"{e['effect']}@{e['at']}"): e for e in sealed["effects"]}


def judge(sealed: dict[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    """What became of a case.

    `outcome` is `clean` or `false alarm` where nothing is concealed; else `missed` (no mismatch), `refused`
    (unexplained), `named` (the one answer), `among` (one of at most three answers), `crowd` (one of more), `part` (some
    of a pair and nothing else) or `wrong`. `joint` says whether most of the misfit was located at a joint with an
    effect, None where that is at none.
    """
    truth = set(_hidden(sealed))
    joints = {e["joint"] for e in sealed["effects"]} - {None}
    at = table["locations"][0]["at"].removesuffix("/qpos").removesuffix("/qvel") if table["locations"] else ""
    found = table["confusion_set"] or [[f"{e['effect']}@{e['at']}" for e in table["effects"]]]
    answers = [{_bare(name) for name in answer} for answer in found]
    verdict = table["verdict"]
    if not truth:
        outcome = "clean" if verdict == "no_mismatch" else "false alarm"
    elif verdict in ("no_mismatch", "unexplained"):
        outcome = "missed" if verdict == "no_mismatch" else "refused"
    elif truth in answers:
        outcome = "named" if len(answers) == 1 else "among" if len(answers) <= 3 else "crowd"
    else:
        outcome = "part" if any(answer < truth for answer in answers) else "wrong"
    return {
        "outcome": outcome,
        "single_best": bool(answers[0] == truth) if truth and verdict in ("explained", "ambiguous") else False,
        "third": any(answer - truth for answer in answers),
        "joint": at in joints if joints and verdict != "no_mismatch" else None,
        "found": found,
        "at": at,
    }


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Cases that a file of JSON lines holds."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def resumed(
    cases: Iterable[dict[str, Any]],
    out: Path | None,
    make: Callable[[Path, dict[str, Any]], dict[str, Any]],
    write: Callable[[Path, dict[str, Any]], dict[str, Any]] = make_drawn,
) -> Iterator[dict[str, Any]]:
    """Yield what `make` finds in the folder of every case; rows that the file `out` holds already are not made again.

    A machine that cannot have its effect as strong as drawn is told and left out.
    """
    done: dict[int, dict[str, Any]] = {}
    if out is not None and out.exists():
        done = {row["case"]["seed"]: row for row in read_rows(out)}
    for case in cases:
        row = done.get(case["seed"])
        if row is None or row["case"] != case:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "case"
                try:
                    sealed = write(path, case)
                except (StrengthError, AbsorbedError) as error:
                    print(f"{'not made':<12} {case['rig']} {error}", flush=True)
                    continue
                start = time.perf_counter()
                found = make(path, case)
                seconds = round(time.perf_counter() - start, 1)
            row = {"case": case, "sealed": sealed, "seconds": seconds, **found}
            if out is not None:
                out.parent.mkdir(parents=True, exist_ok=True)
                with out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
        yield row


def diagnose_drawn(path: Path, case: dict[str, Any], effects: Sequence[Any] | None = None) -> CaseDiagnosis:
    """Diagnose a case that was drawn; the next one of the same machine finds what was compiled."""
    from bayessim_jax.recordings.diagnosing import diagnose_case
    from bayessim_jax.recordings.evaluation import BEFORE
    from bayessim_jax.recordings.loading import load_case
    from bayessim_jax.recordings.shots import case_model

    model = case_model(load_case(path).check(), before=BEFORE)
    found = diagnose_case(jax.random.key(case["seed"]), model, effects=effects)
    make_room()
    return found


def diagnose_concealed(options: Namespace) -> None:
    """Diagnose the cases that are not in the file yet, and print what became of all; or that of what was recorded."""
    if options.records:
        sets = {path.stem: _read_judged(path) for path in options.records}
        print(tabulate(sets) if len(sets) > 1 else summarize(*sets.values()))
        return
    rows = diagnose_all(draw_cases(options.rigs or list(MODELS), options.cases, options.seed), options, make_drawn)
    if options.peers:
        print(_name_sparsely(rows))


def diagnose_all(
    drawn: Sequence[dict[str, Any]], options: Namespace, write: Callable[[Path, dict[str, Any]], dict[str, Any]]
) -> list[dict[str, Any]]:
    """Rows of the cases that are asked for, printed as they come, and the scoreboard."""
    jax.config.update("jax_enable_x64", True)

    def make(path: Path, case: dict[str, Any]) -> dict[str, Any]:
        diagnosis = diagnose_drawn(path, case)
        table = diagnosis.table()
        return {
            "verdict": table["verdict"],
            "p_value": table["misfit"]["p_value"],
            "finalists": [entry.names for entry in diagnosis.result.entries],
            "left": diagnosis.shares_left,
            "ahead": [entry.ahead for entry in diagnosis.result.entries],
            "closest": diagnosis.result.entries[0].names if diagnosis.result.entries else [],
            "nrmse": {k: v["nrmse"] for k, v in table["fit"].items() if isinstance(v, dict)},
            "noise_floor": table["fit"]["noise_floor"],
            **{key: table[key] for key in ("parameters", "effects", "confusion_set", "locations")},
        }

    rows = []
    first, parts = options.part
    for made in resumed(drawn[first - 1 :: parts], options.out, make, write):
        row = made | judge(made["sealed"], made)
        rows.append(row)
        hidden = ", ".join(f"{e['effect']}@{e['at']} {e['strength']['measured']:g}" for e in row["sealed"]["effects"])
        print(
            f"{row['outcome']:<12} {row['case']['rig']} {hidden or 'clean'} -> {row['found']} {row['seconds']:.0f} s",
            flush=True,
        )
    print("\n" + summarize(rows))
    return rows


def _name_sparsely(rows: list[dict[str, Any]]) -> str:
    """What sparse regression of residual torques names in the same cases, at the θ of the fit without effects."""
    from benchmarks.peers import require_peers

    require_peers("pysindy")
    from bayessim_jax.recordings.loading import load_case
    from bayessim_jax.recordings.shots import case_model
    from benchmarks.peers.sparse_regression import TERMS, find_terms

    named: dict[str, list[bool]] = {group: [] for group in GROUPS}
    right = []
    for row in rows:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "case"
            make_drawn(path, row["case"])
            theta = {name: table["baseline"]["mean"] for name, table in row["parameters"].items()}
            found = find_terms(case_model(load_case(path).check()), theta)
        named[row["case"]["group"]].append(bool(found))
        if row["case"]["group"] == "single":
            (effect,) = row["sealed"]["effects"]
            term, _, joint = found[0].partition("@") if found else ("", "", "")
            right.append(effect["effect"] in TERMS.get(term, ()) and effect["joint"] in (None, joint))
    counts = ", ".join(f"{group} {sum(x)} of {len(x)}" for group, x in named.items() if x)
    return (
        f"sparse regression (PySINDy): largest term stands for the single effect in {sum(right)} of {len(right)}; "
        f"names something in {counts}"
    )


ABSORBED = 1.1
"""Times the noise that a machine with an effect errs in predictions without it, below which θ makes up for it."""
INSIDE = 1.645
"""Standard deviations to each side that a 90 % interval has."""


def summarize(rows: list[dict[str, Any]]) -> str:
    """The scoreboard: a line for each group, then predictions, parameters and seconds."""
    lines = []
    for group in GROUPS:
        members = [row for row in rows if row["case"]["group"] == group]
        if not members:
            continue
        outcomes = [row["outcome"] for row in members]
        located = [row["joint"] for row in members if row["joint"] is not None]
        parts = [f"{outcome} {outcomes.count(outcome)}" for outcome in sorted(set(outcomes))]
        if group in ("single", "weak", "pair"):
            parts.append(f"single best {sum(row['single_best'] for row in members)}")
        if group == "pair":
            parts.append(f"with a third {sum(row['third'] for row in members)}")
        if located:
            parts.append(f"joint right {sum(located)} of {len(located)}")
        parts.append(f"library without abstention: wrong in {sum(_is_wrong(row) for row in members)}")
        lines.append(f"{group:<8} {len(members):>4}: {', '.join(parts)}")
    for group in ("single", "pair"):
        seen = [row for row in rows if row["case"]["group"] == group and _is_seen(row)]
        if seen:
            told = sum(row["outcome"] in ("named", "among") for row in seen)
            lines.append(
                f"{group}s that lack {STRONG} with the best values of what is unknown, too: "
                f"{told} of {len(seen)} told ({told / len(seen):.0%})"
            )
    missed = [row for row in rows if row["outcome"] == "missed"]
    known = [row["sealed"]["lacks"]["with_best"] < NOTHING for row in missed if "lacks" in row["sealed"]]
    if any(known):
        lines.append(
            f"of the {len(known)} missed, {sum(known)} are other values of what is unknown: with these the model lacks "
            f"less than {NOTHING:.0%} of the forces"
        )
    # records from before that was measured say less
    missed = [row for row in missed if "lacks" not in row["sealed"]]
    part = [row for row in rows if row["outcome"] == "part"]
    for members, told, simulator in ((missed, "missed", "baseline"), (part, "told in part", "augmented")):
        alike = [row["nrmse"][simulator] < ABSORBED * row["noise_floor"] for row in members]
        if any(alike):
            lines.append(
                f"of the {len(alike)} {told}, {sum(alike)} predict within a tenth of the noise without the rest"
            )
    lines += [*_predictions(rows), *_coverage(rows)]
    seconds = np.array([row["seconds"] for row in rows])
    if len(seconds):
        lines.append(f"seconds per case: median {np.median(seconds):.0f}, longest {seconds.max():.0f}")
    return "\n".join(lines)


def _read_judged(path: Path) -> list[dict[str, Any]]:
    """Rows of a file of cases, with what became of them."""
    return [row | judge(row["sealed"], row) for row in read_rows(path)]


def tabulate(sets: dict[str, list[dict[str, Any]]]) -> str:
    """A line of a table for each set of cases: what became of every group, and the median of seconds.

    Told is what is the answer or one of at most three; wrong also what is in a set of more.
    """
    heads = ("set", "cases", "singles told", "wrong", "weak told", "wrong", "pairs told", "one of two", "wrong")
    heads += ("of no library refused", "alarms on clean ones", "s")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name, rows in sets.items():
        cells = [
            name.removeprefix("concealed_").replace("_", " "),
            str(len(rows)),
            _share(rows, "single", "named", "among"),
            str(_count(rows, "single", "wrong", "crowd")),
            _share(rows, "weak", "named", "among"),
            str(_count(rows, "weak", "wrong", "crowd")),
            _share(rows, "pair", "named", "among"),
            str(_count(rows, "pair", "part")),
            str(_count(rows, "pair", "wrong", "crowd")),
            _share(rows, "unknown", "refused", "missed"),
            _share(rows, "clean", "false alarm"),
            f"{np.median([row['seconds'] for row in rows]):.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _count(rows: list[dict[str, Any]], group: str, *outcomes: str) -> int:
    """Cases of a group that came out so."""
    return sum(row["case"]["group"] == group and row["outcome"] in outcomes for row in rows)


def _share(rows: list[dict[str, Any]], group: str, *outcomes: str) -> str:
    """The same, of all of the group."""
    return f"{_count(rows, group, *outcomes)} of {sum(row['case']['group'] == group for row in rows)}"


def _is_seen(row: dict[str, Any]) -> bool:
    """Whether the model with the best values of what is unknown lacks as much as a strong effect; as far as known."""
    return bool(row["sealed"].get("lacks", {}).get("with_best", 0.0) >= STRONG)


def _is_wrong(row: dict[str, Any]) -> bool:
    """Whether what fits best of all names something that is not there."""
    return not {_bare(name) for name in row["closest"]} <= set(_hidden(row["sealed"]))


def _predictions(rows: list[dict[str, Any]]) -> list[str]:
    """How much of the way from the refitted baseline to what noise allows is gone on recordings held out."""
    named = [row for row in rows if row["sealed"]["effects"] and row["effects"]]
    if not named:
        return []
    before, after = (np.array([row["nrmse"][which] for row in named]) for which in ("baseline", "augmented"))
    floor = np.array([row["noise_floor"] for row in named])
    closed = (before - after) / np.maximum(before - floor, 1e-12)
    flexible = np.array([row["nrmse"].get("flexible", np.inf) for row in named])
    return [
        f"held-out error, {len(named)} cases with an answer: {np.median(np.clip(closed, -1, 1)):.1%} (median) of the "
        f"gap from the refitted baseline to the noise is closed; worse than the baseline in {(after > before).sum()}, "
        f"than a force without a name in {(after > flexible).sum()}"
    ]


def _coverage(rows: list[dict[str, Any]]) -> list[str]:
    """How often intervals hold the machine's own numbers, where the answer is right."""
    right = [row for row in rows if row["outcome"] == "named"]
    inside: dict[str, list[bool]] = {"baseline": [], "augmented": [], "effects": []}
    errors: dict[str, list[float]] = {"baseline": [], "augmented": []}
    for row in right:
        for name, table in row["parameters"].items():
            truth = row["sealed"]["parameters"].get(name, 0.0)
            for which in ("baseline", "augmented") if truth else ():
                off = abs(table[which]["mean"] - truth)
                inside[which].append(off <= INSIDE * table[which]["sd"])
                errors[which].append(off / abs(truth))
        worlds = {name: effect["parameters"] for name, effect in _hidden(row["sealed"]).items()}
        for effect in row["effects"]:
            own = worlds[_bare(f"{effect['effect']}@{effect['at']}")]
            for name, found in effect["parameters"].items():
                if name in own:
                    off = found["mean"] - own[name]
                    off = np.angle(np.exp(1j * off)) if found["unit"] == "rad" else off
                    inside["effects"].append(abs(off) <= INSIDE * found["sd"])
    if not inside["augmented"]:
        return []
    lines = [
        f"90 % intervals hold the machine's own parameters in {np.mean(inside['augmented']):.0%} of "
        f"{len(inside['augmented'])} with the effect, {np.mean(inside['baseline']):.0%} without; median error "
        f"{np.median(errors['augmented']):.2%} against {np.median(errors['baseline']):.2%}"
    ]
    if inside["effects"]:
        share = np.mean(inside["effects"])
        whose = f"those of effects hold the world's in {share:.0%} of {len(inside['effects'])}; "
        lines.append(whose + "its laws differ in form from the library's")
    return lines
