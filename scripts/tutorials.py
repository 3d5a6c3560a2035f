"""Five diagnoses from beginning to end: what was hidden, what is said of it. Writes docs/tutorials.md and its reports.

    python scripts/tutorials.py
    python scripts/tutorials.py --only clean --docs /tmp/docs

Each conceals something in the pendulum of docs/examples, or nothing, and diagnoses the recordings, with the commands
that are shown.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MODEL = "docs/examples/pendulum/pendulum.xml"
HEAD = """\
# Tutorials

Recordings of a made-up machine, a pendulum with a motor and an unknown mass, and what `bayessim diagnose` says of them.
`python scripts/tutorials.py` runs the commands and writes this page; a report is one file to open in a browser.
"""


@dataclass(frozen=True)
class Tutorial:
    """What is hidden, and what to look at."""

    title: str
    words: tuple[str, ...]
    """Of `bayessim conceal`, after the model."""
    text: str


TUTORIALS = {
    "clean": Tutorial(
        "Nothing is missing",
        ("--seed", "1"),
        "A machine as its model says, but for its mass. What a fit leaves is white, and no name is looked for.",
    ),
    "explained": Tutorial(
        "One effect",
        ("--effect", "load_dependent_friction", "--at", "joint/hinge", "--seed", "3"),
        "Friction in the gear that grows with the load on it. In the report the effect is drawn as a curve with its "
        "band, and θ stands before and after: without the friction the mass had been bent to make up for it.",
    ),
    "pair": Tutorial(
        "Two effects",
        ("--effect", "soft_stop", "actuator_deadband", "--at", "joint/hinge", "actuator/motor", "--seed", "4"),
        "A motor that does not answer to small commands, and a stop that the pendulum runs into. No single effect "
        "explains the misfit, so pairs are tried.",
    ),
    "ambiguous": Tutorial(
        "Several that these recordings cannot tell apart",
        ("--effect", "armature", "--at", "joint/hinge", "--seed", "2"),
        "A heavy rotor. As the mass is unknown, a longer pendulum of less mass moves in the same way. All names are "
        "given, and a file of commands whose outcome would tell them apart.",
    ),
    "unexplained": Tutorial(
        "None of the candidates",
        ("--effect", "unknown:spots", "--seed", "5"),
        "A force that depends on where the pendulum is in a way that no effect of the library has. It gets no name. "
        "Where it sits is said all the same, and a force without a name shows how well one could predict.",
    ),
}


def main() -> None:
    """Run the tutorials, and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=TUTORIALS, default=[*TUTORIALS])
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="where tutorials.md and its reports go")
    args = parser.parse_args()
    (args.docs / "tutorials").mkdir(parents=True, exist_ok=True)
    parts = [HEAD]
    for name in args.only:
        print(name, flush=True)
        with tempfile.TemporaryDirectory() as place:
            parts.append(run(name, TUTORIALS[name], Path(place), args.docs / "tutorials"))
    (args.docs / "tutorials.md").write_text("\n".join(parts), encoding="utf-8")


def run(name: str, tutorial: Tutorial, place: Path, reports: Path) -> str:
    """Conceal and diagnose; returns the tutorial's part of the page."""
    conceal = ["conceal", MODEL, *tutorial.words, "--out", name]
    diagnose = ["diagnose", name, "--out", f"runs/{name}"]
    (place / MODEL).parent.mkdir(parents=True)
    shutil.copy(ROOT / MODEL, place / MODEL)
    for words in (conceal, diagnose):
        command = [Path(sys.executable).with_name("bayessim"), *words]
        done = subprocess.run(
            command, cwd=place, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
        )
    shutil.copy(place / "runs" / name / "report.html", reports / f"{name}.html")
    table = json.loads((place / "runs" / name / "diagnosis.json").read_text(encoding="utf-8"))
    sealed = json.loads((place / name / "sealed.json").read_text(encoding="utf-8"))
    sentence = next(line for line in reversed(done.stdout.splitlines()) if " s  " in line).partition(" s  ")[2]
    commands = "\n".join(f"bayessim {' '.join(words)}" for words in (conceal, diagnose))
    return "\n".join(
        [
            f"## {tutorial.title}\n",
            f"```\n{commands}\n```\n",
            f"{tutorial.text}\n",
            f"> {sentence}\n",
            *describe(sealed, table),
            f"\n[The report](tutorials/{name}.html)\n",
        ]
    )


def describe(sealed: dict[str, Any], table: dict[str, Any]) -> list[str]:
    """Rows of what was hidden beside what was found."""
    rows = ["| | hidden | found |", "|---|---|---|", f"| verdict | | `{table['verdict']}` |"]
    for name, found in table["parameters"].items():
        before, after = (f"{found[w]['mean']:.4g} ± {found[w]['sd']:.1g}" for w in ("baseline", "augmented"))
        told = after if table["effects"] else before
        bent = f" (without the effect {before})" if table["effects"] else ""
        rows.append(f"| {name}, {found['unit']} | {sealed['parameters'][name]:.4g} | {told}{bent} |")
    named = {f"{e['effect']}@{e['at']}": e for e in table["effects"]}
    for effect in sealed["effects"]:
        name = f"{effect['effect']}@{effect['at']}"
        found = named.pop(name.partition("#")[0], None)
        for key, value in effect["parameters"].items():
            p = found["parameters"].get(key) if found else None
            told = f"{p['mean']:.4g} ± {p['sd']:.1g} {p['unit']}" if p else ""
            rows.append(f"| {name}: {key} | {value:.4g} | {told} |")
    for name, found in named.items():
        for key, p in found["parameters"].items():
            rows.append(f"| {name}: {key} | | {p['mean']:.4g} ± {p['sd']:.1g} {p['unit']} |")
    for place in table["locations"]:
        rows.append(f"| where | | {place['at']}, {place['share']:.0%} of the misfit, {place['regime']} |")
    for names in table["confusion_set"]:
        rows.append(f"| may be | | {' + '.join(names)} |")
    if table["next_experiment"]:
        rows.append(f"| next experiment | | {table['next_experiment']} |")
    fit = table["fit"]
    errors = " to ".join(f"{fit[w]['nrmse']:.3g}" for w in ("baseline", "augmented"))
    rows.append(f"| held-out error, of a channel's spread | {fit['noise_floor']:.3g} is noise | {errors} |")
    return rows


if __name__ == "__main__":
    main()
