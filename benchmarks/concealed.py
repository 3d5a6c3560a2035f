"""Diagnoses of made-up machines with an effect concealed in them: how often it is named, refused, or falsely found."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from benchmarks.worlds import CONCEALED, RIGS, UNKNOWN, make_case

if TYPE_CHECKING:
    from argparse import Namespace

__all__ = ["diagnose_concealed", "draw_cases", "judge"]


def draw_cases(rigs: list[str], count: int, seed: int) -> list[dict[str, Any]]:
    """A stated random set: a fifth clean, a fifth with what no library holds, the rest with an effect of it."""
    rng = np.random.default_rng(seed)
    cases = []
    for index in range(count):
        rig = rigs[int(rng.integers(len(rigs)))]
        about = RIGS[rig]
        joints = 2 if rig in ("double", "cart") else 1
        kind = rng.choice(["clean", "unknown", "known", "known", "known"])
        effect, place = None, int(rng.integers(joints))
        if kind != "clean":
            names = sorted(UNKNOWN if kind == "unknown" else CONCEALED)
            names = [n for n in names if about.drive or not (CONCEALED | UNKNOWN)[n].motor]
            effect = str(rng.choice(names))
            if (CONCEALED | UNKNOWN)[effect].motor:
                place = int(rng.integers(len(about.drive)))
        strength = float(np.round(np.exp(rng.uniform(np.log(0.5), np.log(1.5))), 2))
        velocities = bool(rng.uniform() < 0.75)
        cases.append(
            {
                "rig": rig,
                "effect": effect,
                "place": place,
                "strength": strength,
                "seed": seed * 1000 + index,
                "velocities": velocities,
            }
        )
    return cases


def judge(case: dict[str, Any], table: dict[str, Any], joints: list[str], motors: list[str]) -> str:
    """What became of a case: `clean`, `false alarm`, `named`, `among`, `missed`, `refused`, `wrong`."""
    verdict, effect = table["verdict"], case["effect"]
    if effect is None:
        return "clean" if verdict == "no_mismatch" else "false alarm"
    if verdict == "no_mismatch":
        return "missed"
    if verdict == "unexplained":
        return "refused"
    sets = table["confusion_set"] or [[f"{e['effect']}@{e['at']}" for e in table["effects"]]]
    if effect in UNKNOWN:
        return "wrong"
    place = case["place"]
    if CONCEALED[effect].motor:
        at = f"actuator/{motors[place]}"
    elif effect == "base_tilt":
        at = "world"
    else:
        at = f"joint/{joints[place]}" + ("/qpos" if effect.startswith("sensor") else "")
    name = f"{effect}@{at}"
    if [name] in sets:
        return "named" if len(sets) == 1 else "among"
    return "wrong"


def diagnose_concealed(options: Namespace) -> None:
    """Diagnose the cases that are not in the file yet, and print what became of all."""
    from bayessim_jax.recordings.diagnosing import diagnose_case
    from bayessim_jax.recordings.evaluation import BEFORE_ROWS
    from bayessim_jax.recordings.loading import load_case
    from bayessim_jax.recordings.shots import case_model

    jax.config.update("jax_enable_x64", True)
    done: dict[int, dict[str, Any]] = {}
    if options.out is not None and options.out.exists():
        rows = [json.loads(line) for line in options.out.read_text(encoding="utf-8").splitlines()]
        done = {row["case"]["seed"]: row for row in rows}
    for case in draw_cases(options.rigs, options.cases, options.seed):
        row = done.get(case["seed"])
        if row is None or row["case"] != case:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "case"
                arguments = {k: case[k] for k in ("place", "strength", "seed", "velocities")}
                make_case(path, case["rig"], case["effect"], **arguments)
                start = time.perf_counter()
                model = case_model(load_case(path).check(), before=BEFORE_ROWS)
                found = diagnose_case(jax.random.key(case["seed"]), model)
                seconds = time.perf_counter() - start
                table = found.table()
            m = model.system.engine.model
            joints, motors = [m.joint(i).name for i in range(m.njnt)], [m.actuator(i).name for i in range(m.nu)]
            row = {
                "case": case,
                "seconds": round(seconds, 1),
                "outcome": judge(case, table, joints, motors),
                "verdict": table["verdict"],
                "found": table["confusion_set"] or [[f"{e['effect']}@{e['at']}" for e in table["effects"]]],
                "p_value": table["misfit"]["p_value"],
                "place": table["locations"][0]["at"] if table["locations"] else "",
                "nrmse": {k: v["nrmse"] for k, v in table["fit"].items() if isinstance(v, dict)},
                "noise_floor": table["fit"]["noise_floor"],
                "entries": [[e.names, round(e.score, 1)] for e in found.result.entries[:4]],
                "left": [round(x, 4) for x in found.shares_left[:4]],
            }
            if options.out is not None:
                with options.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
            jax.clear_caches()
        done[case["seed"]] = row
        about = f"{case['rig']} {case['effect']} x{case['strength']:g} at {case['place']}"
        print(f"{row['outcome']:<12} {about:<48} {row['found']} {row['seconds']:.0f} s", flush=True)
    _summarize([done[case["seed"]] for case in draw_cases(options.rigs, options.cases, options.seed)])


def _summarize(rows: list[dict[str, Any]]) -> None:
    groups = {
        "clean": [r for r in rows if r["case"]["effect"] is None],
        "in no library": [r for r in rows if r["case"]["effect"] in UNKNOWN],
        "concealed": [r for r in rows if r["case"]["effect"] in CONCEALED],
    }
    print()
    for name, members in groups.items():
        if members:
            outcomes = [r["outcome"] for r in members]
            counts = ", ".join(f"{o} {outcomes.count(o)}" for o in sorted(set(outcomes)))
            print(f"{name}: {len(members)} cases: {counts}")
    print(f"seconds per case: median {np.median([r['seconds'] for r in rows]):.0f}")
