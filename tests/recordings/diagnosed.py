"""Run folders of diagnoses made up for what is built on them: the files, without the work."""

import dataclasses

from bayessim_jax.effects import Scales
from bayessim_jax.recordings.files import to_json
from bayessim_jax.recordings.run_folder import RunFolder
from tests.recordings.made_up_case import MODEL, columns, write_case

FLOOR = '<geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -2"/>'
RIG = MODEL.replace(FLOOR, "")
"""Without contacts."""


def write_diagnosis(
    folder,
    verdict="explained",
    effects=(("coulomb_friction", {"coulomb": (0.05, 0.01)}),),
    mass=(0.3, 0.002),
    noise=(0.001, 0.02),
    confusion=(),
    model=RIG,
    **recordings,
):
    """A case and a diagnosis of it in `folder/run`; means and standard deviations are given in pairs.

    The friction is at the hinge. The baseline has the mass 0.4.
    """
    case = write_case(folder / "case", model=model, **(recordings or {"run1": columns()}))
    run = RunFolder(folder / "run").create()
    run.write_config({"command": "diagnose", "case": str(case), "engine": "auto", "seed": 0})
    named = verdict in ("explained", "ambiguous")
    table = {
        "schema": 1,
        "case": "rig",
        "verdict": verdict,
        "effects": [
            {"effect": name, "at": "joint/hinge", "parameters": {p: {"mean": m, "sd": s} for p, (m, s) in own.items()}}
            for name, own in effects
            if named
        ],
        "confusion_set": confusion,
        "parameters": {
            "bob_mass": {"baseline": {"mean": 0.4, "sd": 0.1}, "augmented": {"mean": mass[0], "sd": mass[1]}}
        },
    }
    names = [n for n in ("joint/hinge/qpos", "joint/hinge/qvel") if n in (next(iter(recordings.values()), columns()))]
    common = {"spread": [], "noise": list(noise)[: len(names)]}
    values = [m for _, own in effects for m, _ in own.values()]
    state = {
        "schema": 1,
        "channels": names,
        "refined": 1,
        "nearest": 1,
        "scales": {"joint/hinge": dataclasses.asdict(Scales())},
        "simulators": {
            "baseline": {"effects": [], "rounded": [], "theta": [0.4], "values": [], **common},
            "augmented": {
                "effects": [[n, "joint/hinge"] for n, _ in effects], "rounded": [False] * len(effects),
                "theta": [mass[0]], "values": values, **common
            },
        },
    }  # fmt: skip
    (run.path / "diagnosis.json").write_text(to_json(table))
    (run.path / "simulators.json").write_text(to_json(state))
    return run.path
