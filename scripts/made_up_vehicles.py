"""Skid-steered vehicles with something left out of their simulator: what the diagnosis says of each.

    python scripts/made_up_vehicles.py --out benchmarks/results/made_up_vehicles.jsonl

Vehicles and ground are NumPy's (`benchmarks/vehicle.py`): eight drives of 5 s, noise of 0.01 m and rad. With all
runs in the file of records nothing is simulated.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trials import gather, resume

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.vehicle import Vehicle, write_case

if TYPE_CHECKING:
    from collections.abc import Iterable

VEHICLES = {
    "nothing": (Vehicle(), 6),
    "slip of 20 % ahead and 18 % in turning": (Vehicle(slip=0.2, turning_slip=0.18), 2),
    "both sides lag by 0.15 s": (Vehicle(lag=(0.15, 0.15)), 2),
    "the same, and slip": (Vehicle(lag=(0.15, 0.15), slip=0.2, turning_slip=0.18), 2),
    "the left side lags by 0.15 s": (Vehicle(lag=(0.15, 0.0)), 2),
    "the sides lag by 0.12 and 0.25 s": (Vehicle(lag=(0.12, 0.25)), 3),
    "both sides are late by 0.2 s": (Vehicle(delay=0.2), 2),
    "both sides lag by 0.17 s and are late by 0.1 s": (Vehicle(lag=(0.17, 0.17), delay=0.1), 3),
    "turning slips by 5 to 65 %, up and down in 1.7 s": (Vehicle(turning_slip=0.35, swing=0.3), 3),
}
"""What is left out, and how many such vehicles are made."""


def main() -> None:
    """Diagnose the vehicles that are not in the file yet, and print the table of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="file of JSON lines to append to, and to resume from")
    args = parser.parse_args()
    lines = ["| left out | answers |", "|---|---|"]
    for left_out, (vehicle, runs) in VEHICLES.items():
        trials = resume(partial(diagnose, vehicle), runs, args.out, {"left_out": left_out})
        lines.append(f"| {left_out} | {_answers(gather(trials, runs, left_out))} |")
    print(80 * " " + "\r" + "\n".join(lines))


def diagnose(vehicle: Vehicle, seed: int) -> dict[str, Any]:
    """The verdict on one vehicle, and the effects that are named with their numbers."""
    with tempfile.TemporaryDirectory() as scratch:
        case, run = write_case(Path(scratch) / "case", vehicle, seed), Path(scratch) / "run"
        words = ["diagnose", str(case), "--out", str(run), "--quiet"]
        subprocess.run([sys.executable, "-m", "bayessim_jax", *words], check=True)
        found = json.loads((run / "diagnosis.json").read_text(encoding="utf-8"))
    numbers = {
        f"{e['effect']}@{e['at']}": {name: round(p["mean"], 4) for name, p in e["parameters"].items()}
        for e in found["effects"]
    }
    return {"verdict": found["verdict"], "p_value": found["misfit"]["p_value"], "effects": numbers}


def _answers(rows: list[dict[str, Any]]) -> str:
    """Every answer, how often it was given, and the numbers of its effects."""
    told: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        told.setdefault(" and ".join(sorted(row["effects"])) or row["verdict"], []).append(row)
    return "; ".join(f"`{answer}` {len(same)} of {len(rows)}{_numbers(same)}" for answer, same in told.items())


def _numbers(rows: Iterable[dict[str, Any]]) -> str:
    each: dict[str, list[str]] = {}
    for row in rows:
        for effect in sorted(row["effects"]):
            for value in row["effects"][effect].values():
                each.setdefault(effect, []).append(f"{value:.3f}")
    return f": {'; '.join(', '.join(values) for values in each.values())} s" if each else ""


if __name__ == "__main__":
    main()
