"""What share of a misfit may an explanation leave? Measured on machines whose effect's whole family is left out.

Every machine (`benchmarks.concealed`, with a seed of its own) has one effect concealed in it and is diagnosed twice:
with the whole library, and with all effects of its family taken out of it. The first says how much the right name
leaves, the second how much the best of the wrong ones does. Printed is what every threshold would do to both; the one
in `diagnosis.verdict.Thresholds` is chosen from it, and from no real recording.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from bayessim_jax.diagnosis.verdict import Thresholds, leaves_much
from bayessim_jax.effects import EFFECTS
from benchmarks.concealed import diagnose_drawn, draw_cases, judge, read_rows, resumed

if TYPE_CHECKING:
    from argparse import Namespace
    from pathlib import Path

    from bayessim_jax.recordings.diagnosing import CaseDiagnosis

__all__ = ["hold_against_held_out", "leave_families_out", "relatives", "summarize"]

FAMILIES: dict[str, tuple[str, ...]] = {
    "dry friction": (
        "coulomb_friction",
        "stribeck_friction",
        "asymmetric_friction",
        "load_dependent_friction",
        "lugre_friction",
        "hysteresis",
    ),
    "drag": ("viscous_friction", "quadratic_drag", "back_emf"),
    "springs and weights": (
        "joint_spring",
        "soft_stop",
        "torque_ripple",
        "base_tilt",
        "ground_slope",
        "link_offset",
        "payload",
        "actuator_bias",
    ),
    "late motors": ("actuator_delay", "actuator_lag", "actuator_rate_limit", "joint_flexibility", "backlash"),
    "limited motors": ("actuator_saturation", "actuator_deadband", "actuator_gain"),
    "inertia": ("armature", "payload", "link_offset"),
    "coupling": ("joint_coupling",),
    "what changes": ("gain_drop", "gain_drift", "disturbance_event"),
    "sensors": ("sensor_offset", "sensor_scale", "sensor_delay"),
}
"""Effects that look like one another; `payload` and `link_offset` are of two families."""
RIGS = ["pendulum", "slide", "swing", "cart", "double"]
SEED, DRAWN = 77, 240
"""Of the machines, and how many are drawn at least: of fewer that are diagnosed the first are the same."""
TRIED = (0.005, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15)
PRODUCTS = (0.0001, 0.0003, 0.001, 0.003, 0.01, 0.03)


def relatives(effect: str) -> set[str]:
    """All effects of the families of one."""
    return {effect}.union(*(set(members) for members in FAMILIES.values() if effect in members))


def _short(diagnosis: CaseDiagnosis) -> dict[str, Any]:
    """Verdict, answers, the best candidate, and what it leaves of the misfit and of the error ahead."""
    result = diagnosis.result
    best = result.entries[0] if result.entries else None
    return {
        "verdict": result.verdict,
        "confusion_set": [entry.names for entry in result.confusion],
        "names": best.names if best else [],
        "left": diagnosis.shares_left[0] if best else 1.0,
        "ahead": best.ahead if best else float("nan"),
        "p_value": result.best.misfit.p_value,
        "taken_back": result.taken_back is not None,
    }


def leave_families_out(options: Namespace) -> None:
    """Run the cases that are not in the file yet, and print the table; or that of what was recorded."""
    if options.records:
        print(hold_against_held_out(options.records))
        return
    jax.config.update("jax_enable_x64", True)
    drawn = draw_cases(options.rigs or RIGS, max(DRAWN, 4 * options.cases), SEED)
    cases = [case for case in drawn if case["group"] == "single"][: options.cases]

    def make(path: Path, case: dict[str, Any]) -> dict[str, Any]:
        without = [effect for name, effect in EFFECTS.items() if name not in relatives(case["effects"][0])]
        return {
            "whole": _short(diagnose_drawn(path, case)),
            "without": _short(diagnose_drawn(path, case, without)),
        }

    rows = []
    for row in resumed(cases, options.out, make):
        rows.append(row)
        print(row["case"]["rig"], *row["case"]["effects"], row["whole"], row["without"], flush=True)
    print("\n" + summarize(rows))


def summarize(rows: Sequence[dict[str, Any]]) -> str:
    """What becomes of the answers, and what every threshold would do: right names kept, wrong ones let through."""
    seen = [row for row in rows if row["without"]["verdict"] != "no_mismatch"]
    named = [row for row in seen if row["case"]["effects"] == [n.partition("@")[0] for n in row["whole"]["names"]]]
    lines = []
    for which, said in (("whole", "the whole library"), ("without", "without the family")):
        verdicts = Counter(row[which]["verdict"] for row in rows)
        back = sum(row[which]["taken_back"] for row in rows)
        parts = ", ".join(f"{verdict} {verdicts[verdict]}" for verdict in sorted(verdicts))
        lines.append(f"{said}: {parts}; taken back by recordings left out {back}")
    lines.append(f"{len(named)} right names come first, {len(seen)} machines show a misfit without the family")
    for key, what, tried in (("left", "left", TRIED), ("both", "left × ahead", PRODUCTS)):
        right, wrong = (
            np.array([_leaves(row[side], key) for row in of]) for side, of in (("whole", named), ("without", seen))
        )
        lines.append(f"{what:<13} right kept   wrong let through")
        lines += [f"{t:<13g} {np.mean(right <= t):>10.1%} {np.mean(wrong <= t):>19.1%}" for t in tried if len(right)]
    return "\n".join(lines)


def _leaves(found: dict[str, Any], key: str) -> float:
    """The share of the misfit, or times that of the error ahead; what was not looked at ahead leaves all of it."""
    return found["left"] * (1.0 if key == "left" or not np.isfinite(found["ahead"]) else found["ahead"])


def hold_against_held_out(records: Sequence[Path]) -> str:
    """How many recorded answers, of what kind, `leaves_much` takes back, and the least that single effects leave ahead.

    The latter are finalists for an effect of no library, of older records the one that came closest; with a memory they
    are excused where their past is unknown.
    """
    rows = [row for path in records for row in read_rows(path)]
    found, back = Counter[str](), Counter[str]()
    nearest: dict[bool, list[tuple[float, str]]] = {True: [], False: []}
    unknown = [row for row in rows if row["case"]["group"] == "unknown"]
    for row in rows:
        if row["verdict"] in ("explained", "ambiguous"):
            outcome = judge(row["sealed"], row)["outcome"]
            kinds = ["right" if outcome in ("named", "among") else outcome]
            kinds += ["in no library"] if row in unknown else []
            found.update(kinds)
            nrmse, floor = row["nrmse"], row["noise_floor"]
            if leaves_much(nrmse["baseline"], nrmse["augmented"], floor, Thresholds()):
                back.update(kinds)
    for row in unknown:
        finalists = row.get("finalists", [row["closest"]])
        for names, ahead in zip(finalists, row.get("ahead", ()), strict=False):
            if len(names) == 1 and np.isfinite(ahead):
                recalls = bool(getattr(EFFECTS[names[0].partition("@")[0]], "recalls", False))
                nearest[recalls].append((ahead, f"{names[0]} for {row['case']['effects'][0]}"))
    lines = [f"{kind}: {back[kind]} of {count} taken back" for kind, count in found.items()]
    for recalls, each in nearest.items():
        if each:
            share, name = min(each)
            kind = "with a memory" if recalls else "without one"
            lines.append(
                f"single effects {kind} among the finalists, {len(each)}: {share:.1%} of the error ahead, {name}"
            )
    return "\n".join(lines)
