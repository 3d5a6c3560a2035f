"""What every physical effect promises: a change of a simulator at one of four ports, with parameters of its own.

The ports, in the order in which a time step passes them:

- `act`: what the actuator makes of the command;
- `model`: numbers of the model that become functions of the parameters;
- `force`: a generalized force on a joint;
- `sense`: what a sensor makes of the state.

Everything is written for one place, one trajectory and one set of parameters, in SI units; callers batch with
`jax.vmap`. At its neutral parameters an effect changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float

from bayessim_jax.contracts import Scalar

__all__ = [
    "ActEffect",
    "Effect",
    "EffectParameter",
    "ForceEffect",
    "Memory",
    "ModelEffect",
    "Moment",
    "Number",
    "Numbers",
    "Past",
    "Scales",
    "SenseEffect",
    "Values",
]

Number = Scalar | float
Values = Mapping[str, Scalar]
"""The parameters of an effect by name."""
Memory = Any
"""What an effect remembers from one time step to the next: a pytree of arrays, `()` where there is nothing."""
Place = tuple[str, tuple[int, ...]]
"""One number of the model: a field of `mjModel` (or `gravity`) and an index."""
Numbers = Callable[..., Any]
"""`numbers(field, *index)`: one number of the model, with θ in it."""


@dataclass(frozen=True)
class Scales:
    """How large things are at one place, from the recordings and the model: what priors are made of.

    Magnitudes are what 95 % of the recorded samples stay below; positions are taken from their mean.
    """

    position: float = 1.0
    """m or rad."""
    speed: float = 3.0
    """m/s or rad/s."""
    force: float = 1.0
    """N or N m, all that moves the joint."""
    command: float = 1.0
    """In the unit of the command."""
    period: float = 0.01
    """One control period, s."""
    inertia: float = 0.1
    """What the joint feels, 1/(M⁻¹)ⱼⱼ, kg or kg m²."""
    duration: float = 10.0
    """Of a recording, s."""
    timestep: float = 0.002
    """Of the model, s."""
    shift: float = 0.0
    """s by which the time step of the simulator may move things in time by itself."""
    centre: float = 0.0
    """Mean position, m or rad."""
    mass: float = 1.0
    """Of the body at the place, kg."""
    length: float = 0.3
    """Of the body at the place, m."""
    friction: float = 1.0
    """Coefficient of the contact at the place in the model."""
    unit: str = "rad"
    """Of the position."""
    other_position: float = 1.0
    """Of the joint that acts on this one, m or rad, where the place names one."""
    other_speed: float = 3.0
    """Of that joint, m/s or rad/s."""
    other_unit: str = "rad"
    """Of its position."""

    @property
    def force_unit(self) -> str:
        """In N for what slides, in N m for what turns."""
        return "N" if self.unit == "m" else "N m"

    @property
    def inertia_unit(self) -> str:
        """In kg for what slides, in kg m² for what turns."""
        return "kg" if self.unit == "m" else "kg m²"

    @property
    def stiffest(self) -> float:
        """The stiffness whose oscillation one can still follow with this time step, ω h = ½."""
        return 0.25 * self.inertia / self.timestep**2


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect at one place: its range, where it does nothing, and where a fit begins."""

    name: str
    unit: str
    low: float
    high: float
    neutral: float
    """May lie outside of the range, as no limit (∞) does."""
    start: float
    log: bool = False
    """Whether a fit is better done in its logarithm; `low` is then above 0."""
    scan: int = 0
    """So many values, spread evenly over the range, are begun from, because the likelihood may have many maxima.

    Parameters of one unit go together, such as the beginning and the end of an event.
    """
    form: float = 0.005
    """Relative standard deviation of the number between forms of the law in use, which recordings do not tell.

    An interval is never narrower: a friction that recordings fix to a thousandth with one smooth sign is another with
    another one. Of an effect's moments it is relative to the time between them.
    """

    least: float = 0.0
    """Magnitude below which it is no effect but the time step of the simulator: it is fitted, and not named."""
    moment: bool = False
    """A moment, from which on the effect acts: near the end of a window predictions hardly depend on it."""

    def __post_init__(self) -> None:
        if not self.low < self.start < self.high:
            raise ValueError(f"parameter {self.name!r}: start {self.start} is not inside ({self.low}, {self.high}).")
        if self.log and self.low <= 0.0:
            raise ValueError(f"parameter {self.name!r}: low {self.low} has no logarithm; set it above 0.")


class Moment(NamedTuple):
    """What an effect sees at the beginning of a time step of h seconds."""

    time: Scalar
    """s since the beginning of the recording."""
    h: float
    position: Number = 0.0
    """Of the joint, or of the one that the actuator drives, m or rad."""
    velocity: Number = 0.0
    acceleration: Number = 0.0
    """What the joint would do in this time step without the holding effects at it, m/s² or rad/s²."""
    inertia: Number = 1.0
    """What the joint feels, 1/(M⁻¹)ⱼⱼ, underestimated so that forces computed from it never overshoot."""
    drive: Number = 0.0
    """What the actuators exert on the joint, N or N m."""
    gain: Number = 1.0
    """At an actuator's command: N or N m on the joint for one unit of it."""
    jerk: Number = 0.0
    """How the acceleration changes, where a sensor's effect begins."""
    prompt: bool = False
    """Whether velocity, acceleration and jerk are those of now where a sensor shows a position late."""
    other: Any = None
    """The same for the second joint of a place that has two."""
    detail: str = ""
    """What stands after the `#` of the place."""

    @property
    def stop(self) -> Number:
        """What would have to be taken away to bring the joint to rest by the end of this time step, N or N m.

        `−clip(stop, −F, F)` is dry friction of the level F that holds: m (v/h + a) is what moves the joint.
        """
        return self.inertia * (self.velocity / self.h + self.acceleration)


class Past(NamedTuple):
    """How a joint moved before a simulation begins, in steps of `period` s."""

    positions: Float[Array, " steps_and_one"]
    """At both ends of every step, m or rad; the last is that of the state in which the simulation begins."""
    velocities: Float[Array, " steps_and_one"]
    drives: Float[Array, " steps"]
    """What actuators exerted on the joint during every step, N or N m."""
    recorded: Bool[Array, " steps"]
    """Which steps were recorded; in those before a recording the joint is taken to coast."""
    period: float
    h: float = 0.0
    """s, the time step of the simulation, in which a memory is that of one step ago."""


@runtime_checkable
class Effect(Protocol):
    """What is common to the effects at all ports."""

    name: str
    port: str
    """`act`, `force`, `sense` or `model`."""

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Where it can act: `joint/hinge`, `actuator/m`, `sensor/…`, `joint/…/qpos`, `body/…`, `geom/…`, `world`.

        What stands after a `#` tells apart what lies at one place, such as a direction.
        """
        ...

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """Its parameters there, ranges as wide as the recordings could tell."""
        ...


@runtime_checkable
class ActEffect(Effect, Protocol):
    """Changes the command of an actuator; at a place of several actuators commands are tuples."""

    port: str = "act"
    looks: bool = False
    """Whether it looks at position or velocity; what does not can be worked out before the simulation."""
    hurries: bool = False
    """Whether `ahead` is quicker than `command` at every time step."""
    brief: bool = False
    """Whether it remembers no more than the commands of `history.RECENT` s or of a few time steps; other memories do
    not depend on the step."""

    def choose(self, names: Sequence[str]) -> list[str]:
        """The places among actuators of these names: each of them, unless it takes several."""
        return [f"actuator/{name}" for name in names]

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every actuator, unless `choose` chooses."""
        return self.choose([model.actuator(i).name or f"actuator{i}" for i in range(model.nu)])

    def begin(self, values: Values, command: Any, moment: Moment) -> Memory:
        """The memory after this command has been held for long."""
        return ()

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """What arrives in place of a command, on average over the time step, and the memory for the next one."""
        ...

    def ahead(self, values: Values, memory: Memory, commands: Any, moment: Moment) -> tuple[Any, Memory]:
        """The same for commands that are known beforehand, one for each time step: a leading axis on everything."""

        def once(carry: tuple[Memory, Scalar], command: Any) -> Any:
            memory, time = carry
            new, memory = self.command(values, memory, command, moment._replace(time=time))
            return (memory, time + moment.h), (new, memory)

        return jax.lax.scan(once, (memory, moment.time), commands)[1]


@runtime_checkable
class ForceEffect(Effect, Protocol):
    """Exerts a force on a joint."""

    port: str = "force"
    holds: bool = False
    """Whether it looks at `acceleration` or `stop`, and so must not find its own force in them."""
    feels: bool = False
    """Whether it looks at `drive`, or at `acceleration` where a simulation begins; known of what holds anyway."""
    recalls: bool = False
    """Whether it remembers what happened long before; otherwise the state that it begins in says enough."""
    settles: bool = True
    """Whether the state says what it remembers when a recording begins; otherwise fits find it window by window."""

    def begin(self, values: Values, moment: Moment) -> Memory:
        """The memory with which a simulation begins in this state, as if it had lasted."""
        return ()

    def recall(self, values: Values, memory: Memory, past: Past, move: Number = 0.0) -> Memory:
        """The memory after a joint has moved so, into a state that it would begin in with this memory.

        An effect that does not settle remembers a best guess before that where `move` is 0, and is N(0, 1) a priori.
        """

        def once(memory: Memory, now: tuple[Array, Array, Array]) -> tuple[Memory, None]:
            position, velocity, drive = now
            moment = Moment(jnp.zeros(()), past.period, position, velocity, drive=drive)
            return self.force(values, memory, moment)[1], None

        return jax.lax.scan(once, memory, (past.positions[:-1], past.velocities[:-1], past.drives))[0]

    def trade(self, values: dict[str, float]) -> list[dict[str, float]]:
        """Other numbers that do much the same, far along a bend that fits do not find around."""
        return []

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """The force during the time step, N or N m, and the memory for the next one."""
        ...

    def slopes(self, values: Values, moment: Moment) -> Array | None:
        """The force's derivatives along all numbers, where an effect without memory has so many that these are cheaper.

        None for those that JAX finds.
        """
        return None


@runtime_checkable
class SenseEffect(Effect, Protocol):
    """Changes what a sensor shows."""

    port: str = "sense"
    remembers: bool = False
    """Whether it has a memory, which is then brought up to date at the end of every control period."""

    def begin(self, values: Values, moment: Moment) -> Memory:
        """The memory in this state."""
        return ()

    def track(self, values: Values, memory: Memory, moment: Moment) -> Memory:
        """The memory after a control period of `moment.h` that ended in this state."""
        return memory

    def sense(self, values: Values, memory: Memory, reading: Scalar, moment: Moment) -> Scalar:
        """What is shown instead of the true reading."""
        ...

    def restore(self, values: Values, moment: Moment) -> tuple[Number, Number]:
        """Position and velocity of the joint for which this sensor shows those of `moment`."""
        return moment.position, moment.velocity


@runtime_checkable
class ModelEffect(Effect, Protocol):
    """Makes numbers of the model functions of its parameters."""

    port: str = "model"

    def targets(self, model: mujoco.MjModel, place: str) -> tuple[Place, ...]:
        """The numbers that it sets: field of `mjModel` and index."""
        ...

    def edit(self, values: Values, numbers: Numbers, model: mujoco.MjModel, place: str) -> tuple[Number | Array, ...]:
        """What they become, in that order."""
        ...
