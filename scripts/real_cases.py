"""Real machines: what is learned of their parameters, how well they are predicted before and after, in which time.

    python scripts/real_cases.py PATH/TO/CASES --out benchmarks/results/real_cases.jsonl

Runs `bayessim infer` with seed 0 on every case of the folder, twice: with an empty cache of compiled programs and with
the one that the first run left. Errors are of predictions one horizon ahead on windows that were not fitted, as shares
of a channel's spread, averaged over channels: at the priors' means (before) and at the posterior's (after). *windows*
are those fitted and those left out. Without the cases the table is printed from the file of records.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trials import load, save

if TYPE_CHECKING:
    from collections.abc import Iterable

HEAD = """\
| case | engine | sampler | windows | error before | after | parameters | first, s | again, s |
|---|---|---|---|---|---|---|---|---|"""


def main() -> None:
    """Infer the cases that are not in the file yet, and print the table of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", type=Path, nargs="?", help="folder that holds the cases")
    parser.add_argument("--out", type=Path, required=True, help="file of JSON lines to append to, and to resume from")
    args = parser.parse_args()
    known = {row["case"]: row for row in load(args.out, {})}
    for folder in sorted(path.parent for path in args.cases.glob("*/case.toml")) if args.cases else ():
        if folder.name not in known:
            print(f"{folder.name} …", end="\r", flush=True)
            known[folder.name] = infer(folder)
            save(args.out, known[folder.name])
    print(summarize(known.values()))


def infer(folder: Path) -> dict[str, Any]:
    """What a user gets of a case, and the seconds of the command with an empty and with a filled cache."""
    seconds = []
    with tempfile.TemporaryDirectory() as scratch:
        space = os.environ | {"JAX_COMPILATION_CACHE_DIR": f"{scratch}/programs"}
        for turn in range(2):
            command = [sys.executable, "-m", "bayessim_jax", "infer", str(folder), "--quiet", "--seed", "0"]
            start = time.monotonic()
            subprocess.run([*command, "--out", f"{scratch}/{turn}"], env=space, check=True)
            seconds.append(round(time.monotonic() - start, 1))
        found = json.loads((Path(scratch) / "1" / "inference.json").read_text(encoding="utf-8"))
    moments = {k: {name: p[name] for name in ("mean", "sd", "unit")} for k, p in found["parameters"].items()}
    kept = {name: found[name] for name in ("fit", "identifiability", "engine", "sampler")}
    return {"case": folder.name, "parameters": moments, **kept, "first": seconds[0], "again": seconds[1]}


def summarize(rows: Iterable[dict[str, Any]]) -> str:
    """A line for each case."""
    lines = [HEAD]
    for row in sorted(rows, key=lambda row: row["case"]):
        fit = row["fit"]
        parameters = "; ".join(f"{name} {_number(p)}" for name, p in row["parameters"].items())
        errors = [_percent(fit[which]["nrmse"]) for which in ("baseline", "posterior")]
        windows = f"{fit['windows']['fitted']} + {fit['windows']['held_out']}"
        cells = (row["case"], row["engine"]["name"], row["sampler"], windows, *errors)
        lines.append(f"| {' | '.join(cells)} | {parameters} | {row['first']:.0f} | {row['again']:.0f} |")
    return "\n".join(lines)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"


def _number(moments: dict[str, Any]) -> str:
    unit = f" {moments['unit']}" if moments["unit"] else ""
    return f"{moments['mean']:.4g} ± {moments['sd']:.1g}{unit}"


if __name__ == "__main__":
    main()
