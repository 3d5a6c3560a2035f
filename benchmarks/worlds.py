"""Machines to conceal effects in: their models, what is unknown in them, and how long they are predicted."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayessim_jax.recordings.concealing import conceal
from benchmarks.mechanisms import SMOOTH_MODELS

__all__ = ["MODELS", "RIGS", "Rig", "make_case"]


@dataclass(frozen=True)
class Rig:
    """A machine with one to six joints."""

    xml: str
    parameters: tuple[str, ...]
    """Paths to what is unknown in it."""
    horizon: float = 0.5
    motions: str = "mixed"


def _rig(body: str, actuators: str = "") -> str:
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
        f"<worldbody>{body}</worldbody><actuator>{actuators}</actuator></mujoco>"
    )


RIGS = {
    "pendulum": Rig(
        _rig(
            '<body name="rod"><joint name="hinge" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.3" mass="0.5" diaginertia="0.004 0.004 0.0005"/></body>',
            '<motor name="motor" joint="hinge" gear="1"/>',
        ),
        ("body/rod/mass",),
    ),
    "swing": Rig(
        _rig(
            '<body name="rod"><joint name="hinge" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.25" mass="0.4" diaginertia="0.004 0.004 0.0005"/></body>'
        ),
        ("body/rod/ipos/2",),
        horizon=1.0,
    ),
    "pivot": Rig(
        _rig(
            '<body name="rod"><joint name="hinge" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.2" mass="0.3" diaginertia="0.002 0.002 0.0003"/></body>'
        ),
        ("body/rod/ipos/2",),
        horizon=1.0,
        motions="released",
    ),
    "chain": Rig(
        _rig(
            '<body name="upper"><joint name="shoulder" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.12" mass="0.5" diaginertia="0.004 0.004 0.0005"/>'
            '<body name="lower" pos="0 0 -0.25"><joint name="elbow" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.1" mass="0.3" diaginertia="0.002 0.002 0.0003"/></body></body>'
        ),
        ("body/upper/ipos/2", "body/lower/ipos/2"),
        motions="released",
    ),
    "slide": Rig(
        _rig(
            '<body name="carriage"><joint name="rail" type="slide" axis="1 0 0"/>'
            '<inertial pos="0 0 0" mass="5" diaginertia="0.1 0.1 0.1"/></body>',
            '<motor name="motor" joint="rail" gear="1"/>',
        ),
        ("body/carriage/mass",),
    ),
    "double": Rig(
        _rig(
            '<body name="upper"><joint name="shoulder" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.15" mass="0.6" diaginertia="0.005 0.005 0.0005"/>'
            '<body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.15" mass="0.4" diaginertia="0.003 0.003 0.0003"/></body></body>',
            '<motor name="m1" joint="shoulder" gear="1"/><motor name="m2" joint="elbow" gear="1"/>',
        ),
        ("body/upper/mass", "body/lower/mass"),
    ),
    "servo": Rig(
        _rig(
            '<body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.02"/>'
            '<inertial pos="0 0 -0.12" mass="0.8" diaginertia="0.006 0.006 0.0005"/>'
            '<body name="lower" pos="0 0 -0.25"><joint name="elbow" axis="0 1 0" damping="0.01"/>'
            '<inertial pos="0 0 -0.12" mass="0.4" diaginertia="0.002 0.002 0.0003"/></body></body>',
            '<position name="s1" joint="shoulder" kp="15" kv="0.6"/>'
            '<position name="s2" joint="elbow" kp="6" kv="0.2"/>',
        ),
        ("body/upper/mass", "body/lower/mass"),
    ),
    "cart": Rig(
        _rig(
            '<body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>'
            '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
            '<body name="pole"><joint name="pivot" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.3" mass="0.3" diaginertia="0.005 0.005 0.0005"/></body></body>',
            '<motor name="motor" joint="rail" gear="1"/>',
        ),
        ("body/cart/mass", "body/pole/mass"),
    ),
    "sled": Rig(
        _rig(
            '<geom name="floor" type="plane" size="5 5 1" friction="0.4"/>'
            '<body name="sled" pos="0 0 0.1"><joint name="rail" type="slide" axis="1 0 0"/>'
            '<joint name="lift" type="slide" axis="0 0 1"/>'
            '<geom name="runner" type="box" size="0.2 0.1 0.1" mass="2" friction="0.4"/></body>',
            '<motor name="motor" joint="rail"/>',
        ),
        ("body/sled/mass",),
    ),
    "arm3": Rig(SMOOTH_MODELS["3-joint arm"].xml, ("body/shoulder/mass", "body/elbow/mass")),
    "arm6": Rig(SMOOTH_MODELS["6-joint arm"].xml, ("body/shoulder/mass", "body/elbow/mass", "body/wrist_1/mass")),
}


MODELS = ("pendulum", "slide", "double", "cart", "arm3", "arm6")
"""Those that are diagnosed unless others are asked for: one to six joints, without contacts."""


STEP = "0.002"
"""Time step of every rig, s."""


def make_case(
    folder: Path, rig: str, effect: str | list[str] | None = None, *, finer: float = 1, **settings: Any
) -> dict[str, Any]:
    """Conceal effects in a rig; returns what is sealed.

    The machine is simulated with a time step that is `finer` times shorter than `conceal` takes for the rig's model.
    """
    about = RIGS[rig]
    own = f'timestep="{STEP}"'
    if own not in about.xml:
        raise ValueError(f"rig {rig}: its time step is not {STEP} s.")
    with tempfile.TemporaryDirectory() as place:
        model = Path(place) / "model.xml"
        model.write_text(about.xml.replace(own, f'timestep="{float(STEP) / finer:.9g}"'), encoding="utf-8")
        usual: dict[str, Any] = {
            "parameters": about.parameters,
            "horizon": about.horizon,
            "motions": about.motions,
            "rate": 0.5 / float(STEP),
        }
        sealed = conceal(folder, model, effect, **(usual | settings))
    (folder / "model.xml").write_text(about.xml, encoding="utf-8")
    return sealed
