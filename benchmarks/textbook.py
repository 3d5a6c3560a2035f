"""Effects as a textbook has them, for machines that are stepped by MuJoCo in a loop."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from bayessim_jax.concealment import UNKNOWN

__all__ = ["COMMANDS", "EDITS", "ELASTIC", "FORCES", "GRAVITY", "Law", "Moment", "Spot"]

GRAVITY = 9.81


@dataclass(frozen=True)
class Spot:
    """Where an effect is, and how strong."""

    joint: int
    size: float
    """Share of the force there."""
    force: float
    speed: float
    reach: float
    seconds: float
    """Of a recording."""
    inertia: float
    """That the joint moves, where the machine begins."""


class Moment(NamedTuple):
    """What a law may know of a joint, now."""

    u: float
    """What the motor is told, or exerts; 0 where there is none."""
    q: float
    v: float
    t: float
    h: float
    """The time step that follows."""
    other: tuple[float, float] = (0.0, 0.0)
    """Position and velocity of the first other joint."""


Law = Callable[[Moment], float]
Builder = Callable[[Spot, np.random.Generator], Callable[[], Law]]


def _viscous(model: mujoco.MjModel, spot: Spot, rng: np.random.Generator) -> None:
    model.dof_damping[spot.joint] += spot.size * spot.force / spot.speed


def _coulomb(model: mujoco.MjModel, spot: Spot, rng: np.random.Generator) -> None:
    model.dof_frictionloss[spot.joint] += 0.7 * spot.size * spot.force


def _rotor(model: mujoco.MjModel, spot: Spot, rng: np.random.Generator) -> None:
    model.dof_armature[spot.joint] += spot.size * spot.inertia


def _spring(model: mujoco.MjModel, spot: Spot, rng: np.random.Generator) -> None:
    model.jnt_stiffness[spot.joint] = spot.size * spot.force / spot.reach
    model.qpos_spring[spot.joint] = 0.25 * spot.reach * rng.uniform(-1.0, 1.0)


def _tilt(model: mujoco.MjModel, spot: Spot, rng: np.random.Generator) -> None:
    angle = rng.uniform(0.08, 0.25) * rng.choice([-1.0, 1.0])
    model.opt.gravity[:] = GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle)


def _payload(model: mujoco.MjModel, spot: Spot, rng: np.random.Generator) -> None:
    """A point at the end of the last rod; the long axis of a rod's inertia is its third."""
    last, add = model.nbody - 1, 1.5 * spot.size * model.body_mass[model.nbody - 1]
    mass, middle = model.body_mass[last], model.body_ipos[last, 2]
    centre = (mass * middle + add * 2.0 * middle) / (mass + add)
    model.body_inertia[last, :2] += mass * (middle - centre) ** 2 + add * (2.0 * middle - centre) ** 2
    model.body_mass[last], model.body_ipos[last, 2] = mass + add, centre


def _off_centre(model: mujoco.MjModel, spot: Spot, rng: np.random.Generator) -> None:
    model.body_ipos[model.nbody - 1, 2] *= 1.0 + spot.size * rng.choice([-1.0, 1.0])


EDITS = {
    "viscous_friction": _viscous,
    "coulomb_friction": _coulomb,
    "armature": _rotor,
    "joint_spring": _spring,
    "base_tilt": _tilt,
    "payload": _payload,
    "link_offset": _off_centre,
}
"""What MuJoCo itself simulates."""


def _always(law: Law) -> Callable[[], Law]:
    """A law without a memory."""
    return lambda: law


def _rubbing(level: Callable[[Moment], float], width: float) -> Callable[[], Law]:
    return _always(lambda now: -level(now) * math.tanh(now.v / width))


def _falling(spot: Spot) -> Callable[[float], float]:
    """Levels of friction that fall from twice to once with the speed."""
    force = 0.5 * spot.size * spot.force
    return lambda v: force + force * math.exp(-((v / (0.08 * spot.speed)) ** 2))


def _stribeck(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    level = _falling(spot)
    return _rubbing(lambda now: level(now.v), 0.004 * spot.speed)


def _uneven(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    force = 0.7 * spot.size * spot.force
    return _rubbing(lambda now: force if now.v > 0.0 else 0.4 * force, 0.004 * spot.speed)


def _loaded(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    force, share = 0.2 * spot.size * spot.force, 0.7 * spot.size
    return _rubbing(lambda now: force + share * abs(now.u), 0.004 * spot.speed)


def _bristles(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    level, stiffness = _falling(spot), spot.size * spot.force / (0.01 * spot.reach)
    damping = math.sqrt(stiffness * spot.inertia)

    def begin() -> Law:
        bent = 0.0

        def law(now: Moment) -> float:
            nonlocal bent
            fastest = now.v - stiffness * abs(now.v) / level(now.v) * bent
            bent += now.h * fastest
            return -stiffness * bent - damping * fastest

        return law

    return begin


def _bouc_wen(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    most, stiffness = 0.15 * spot.reach, 0.7 * spot.size * spot.force / (0.15 * spot.reach)
    share = rng.uniform(0.5, 0.9)

    def begin() -> Law:
        bent = 0.0

        def law(now: Moment) -> float:
            nonlocal bent
            lost = share * abs(now.v) * bent + (1.0 - share) * now.v * abs(bent)
            bent += now.h * (now.v - lost / most)
            return -stiffness * bent

        return law

    return begin


def _drag(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    c = 1.5 * spot.size * spot.force / spot.speed**2
    return _always(lambda now: -c * now.v * abs(now.v))


def _ripple(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    waves, phase = rng.integers(4, 10) / spot.reach, rng.uniform(0.0, 2.0 * math.pi)
    return _always(lambda now: 0.7 * spot.size * spot.force * math.sin(waves * now.q + phase))


def _stop(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    side, limit = rng.choice([-1.0, 1.0]), 0.3 * spot.reach
    stiffness = 3.0 * spot.force / spot.reach
    damping = 0.2 * math.sqrt(stiffness * spot.inertia)

    def law(now: Moment) -> float:
        beyond = side * now.q - limit
        return -side * max(stiffness * beyond + damping * side * now.v, 0.0) if beyond > 0.0 else 0.0

    return _always(law)


def _push(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    width, start = rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.7) * spot.seconds
    height = 2.0 * spot.size * spot.force * rng.choice([-1.0, 1.0])
    inside = lambda t: start < t < start + width  # noqa: E731
    return _always(lambda now: height * math.sin(math.pi * (now.t - start) / width) if inside(now.t) else 0.0)


def _coupled(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    way = int(rng.integers(2))
    gain = spot.size * spot.force / (spot.reach, spot.speed)[way] * rng.choice([-1.0, 1.0])
    return _always(lambda now: gain * now.other[way])


def _hum(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    phase = rng.uniform(0.0, 2.0 * math.pi)
    return _always(lambda now: 0.7 * spot.size * spot.force * math.sin(2.0 * math.pi * 3.3 * now.t + phase))


def _patchy(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    phase, force = rng.uniform(0.0, 2.0 * math.pi), spot.size * spot.force
    return _rubbing(lambda now: force * (math.sin(6.0 * now.q / spot.reach + phase) > 0.3), 0.01 * spot.speed)


def _detent(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    phase, force = rng.uniform(0.0, 2.0 * math.pi), 0.8 * spot.size * spot.force
    slow = lambda v: math.exp(-((v / (0.2 * spot.speed)) ** 2))  # noqa: E731
    return _always(lambda now: -force * math.sin(2.5 * now.q / spot.reach + phase) * slow(now.v))


def _fading(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    c = spot.size * spot.force / spot.speed
    return _always(lambda now: -c * now.v * (1.0 + math.cos(2.0 * math.pi * now.t / 3.0)))


def _warming(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    """A damper that loses half of its grip with what it takes up in some tenth of a recording, and cools slowly."""
    c, cooling = 1.5 * spot.size * spot.force / spot.speed, 0.25 * spot.seconds
    usual = c * (0.4 * spot.speed) ** 2 * 0.1 * spot.seconds

    def begin() -> Law:
        heat = 0.0

        def law(now: Moment) -> float:
            nonlocal heat
            force = -c * now.v / (1.0 + heat)
            heat += now.h * (-force * now.v / usual - heat / cooling)
            return force

        return law

    return begin


def _gusts(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    pushes = rng.normal(size=4096)
    return _always(lambda now: 0.5 * spot.size * spot.force * pushes[int(now.t / 0.25) % len(pushes)])


def _sloshing(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    """A mass that hangs on the joint by a spring, as a liquid in a tank does."""
    hertz = rng.uniform(1.0, 2.5)
    return _on_spring(0.6 * spot.size * spot.inertia, hertz, 0.05, driven=False)


def _on_spring(inertia: float, hertz: float, ratio: float, gap: float = 0.0, driven: bool = True) -> Callable[[], Law]:
    """What arrives at a joint by way of a spring from an inertia, which the motor drives if anything does."""
    stiffness = inertia * (2.0 * math.pi * hertz) ** 2
    damping = 2.0 * ratio * math.sqrt(stiffness * inertia)

    def begin() -> Law:
        place: float | None = None
        speed = 0.0

        def law(now: Moment) -> float:
            nonlocal place, speed
            if place is None:
                place, speed = now.q, now.v
            ahead = place - now.q
            bent = ahead - max(-0.5 * gap, min(0.5 * gap, ahead))
            force = stiffness * bent + (damping * (speed - now.v) if bent or not gap else 0.0)
            speed += now.h * ((now.u if driven else 0.0) - force) / inertia
            place += now.h * speed
            return force

        return law

    return begin


FORCES: dict[str, Builder] = {
    "stribeck_friction": _stribeck,
    "asymmetric_friction": _uneven,
    "load_dependent_friction": _loaded,
    "lugre_friction": _bristles,
    "hysteresis": _bouc_wen,
    "quadratic_drag": _drag,
    "torque_ripple": _ripple,
    "soft_stop": _stop,
    "disturbance_event": _push,
    "joint_coupling": _coupled,
    f"{UNKNOWN}hum": _hum,
    f"{UNKNOWN}patchy": _patchy,
    f"{UNKNOWN}detent": _detent,
    f"{UNKNOWN}fading": _fading,
    f"{UNKNOWN}warming": _warming,
    f"{UNKNOWN}gusts": _gusts,
    f"{UNKNOWN}sloshing": _sloshing,
}
"""Forces on a joint, with a memory that begins anew with every recording, if any."""


def _gain(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    gain = 1.0 + spot.size * rng.choice([-1.0, 1.0])
    return _always(lambda now: gain * now.u)


def _bias(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    return _always(lambda now: now.u + 0.5 * spot.size * spot.force)


def _deadband(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    width = 0.5 * spot.size * spot.force
    return _always(lambda now: math.copysign(max(abs(now.u) - width, 0.0), now.u))


def _saturation(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    limit = rng.uniform(0.35, 0.7) * spot.force
    return _always(lambda now: max(-limit, min(limit, now.u)))


def _drift(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    rate = rng.uniform(0.03, 0.08)
    return _always(lambda now: now.u * (1.0 - rate * now.t))


def _drop(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    when, gain = rng.uniform(0.3, 0.7) * spot.seconds, rng.uniform(0.4, 0.75)
    return _always(lambda now: now.u * (gain if now.t > when else 1.0))


def _back_emf(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    return _always(lambda now: now.u - spot.size * spot.force / spot.speed * now.v)


def _late(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    seconds = rng.uniform(0.02, 0.06)

    def begin() -> Law:
        sent: deque[float] = deque()

        def law(now: Moment) -> float:
            sent.append(now.u)
            while len(sent) > round(seconds / now.h) + 1:
                sent.popleft()
            return sent[0]

        return law

    return begin


def _slow(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    constant = rng.uniform(0.03, 0.12)
    return _following(lambda ahead, h: (1.0 - math.exp(-h / constant)) * ahead)


def _limited(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    most = rng.uniform(2.0, 6.0) * spot.force
    return _following(lambda ahead, h: max(-most * h, min(most * h, ahead)))


def _following(step: Callable[[float, float], float]) -> Callable[[], Law]:
    """What arrives of a command, beginning with the first one."""

    def begin() -> Law:
        arrived: float | None = None

        def law(now: Moment) -> float:
            nonlocal arrived
            arrived = now.u if arrived is None else arrived + step(now.u - arrived, now.h)
            return arrived

        return law

    return begin


def _elastic(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    return _on_spring(spot.size * spot.inertia, rng.uniform(6.0, 15.0), 0.03)


def _loose(spot: Spot, rng: np.random.Generator) -> Callable[[], Law]:
    return _on_spring(0.3 * spot.inertia, 30.0, 0.2, gap=0.3 * spot.size * spot.reach)


ELASTIC = {"joint_flexibility": _elastic, "backlash": _loose}
"""Between a motor's own inertia and its joint: after whatever else becomes of a command."""
COMMANDS: dict[str, Builder] = {
    "actuator_gain": _gain,
    "actuator_bias": _bias,
    "actuator_deadband": _deadband,
    "actuator_saturation": _saturation,
    "actuator_rate_limit": _limited,
    "actuator_delay": _late,
    "actuator_lag": _slow,
    "gain_drift": _drift,
    "gain_drop": _drop,
    "back_emf": _back_emf,
    **ELASTIC,
}
"""What arrives at a joint of its motor's command."""
