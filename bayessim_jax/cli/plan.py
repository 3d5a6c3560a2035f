"""From settings to what the loop needs: the set-up, the target with its hidden truth, one run for each seed."""

from __future__ import annotations

import dataclasses
import inspect
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from bayessim_jax import control, learning, online, systems
from bayessim_jax.cli.citations import used_sources
from bayessim_jax.cli.options import Settings
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.cli.subject import find_subject
from bayessim_jax.contracts import Box
from bayessim_jax.effects.vehicle import TERRAINS, OnVehicle, SkidSteerVehicle
from bayessim_jax.engines.gymnasium import GYMNASIUM, gymnasium_target
from bayessim_jax.engines.rescored import Rescored
from bayessim_jax.engines.simulated import SimulatedTarget
from bayessim_jax.inference.encoders import features_of
from bayessim_jax.inference.estimators import MixtureDensity, fourier_mixture, recurrent_mixture, summary_mixture
from bayessim_jax.inference.fit import Schedule
from bayessim_jax.programs import compile_once
from bayessim_jax.recordings.truths import Truths
from bayessim_jax.spelling import find_named, near_miss

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

__all__ = ["Plan", "make_estimator", "make_plan"]

TRUTH = 0x7275
INFERENCES = {"online": online.FOREVER, "offline": 1, "uniform": 0}


@dataclass(frozen=True)
class Plan:
    """A run, ready to go. `settings` are complete: every prior, schedule and learner number is in them."""

    settings: Settings
    setup: online.Setup
    target: Any
    seeds: list[int]
    hidden: Truths
    """What hides in the target: θ*, and after it parameters of its own, where it has some."""
    remarks: tuple[str, ...] = ()
    """What a person should know before it starts."""

    @property
    def truths(self) -> Truths:
        """θ*, in the parameters of the system that infers it."""
        return self.hidden.leading(self.setup.system.parameters.size)

    @property
    def hidden_names(self) -> tuple[str, ...]:
        """What the columns of `hidden` are called."""
        return (self.target if self.settings.target == "vehicle" else self.setup).system.parameters.names

    def apparent(self, rounds: int) -> Float[np.ndarray, "seed round d"] | None:
        """θ that the vehicle seems to have on its ground in every round; nothing for other targets."""
        if self.settings.target != "vehicle":
            return None
        every = np.stack([self.hidden.at(index) for index in range(1, rounds + 1)], 1)
        return np.asarray(jax.vmap(jax.vmap(self.target.system.apparent))(every))

    @property
    def keys(self) -> jax.Array:
        """One key for each seed."""
        return jax.vmap(jax.random.key)(np.asarray(self.seeds, np.uint32))

    def start(self) -> online.State:
        """The state of every seed before the first round, with a leading axis over the seeds."""
        one = lambda setup, key: online.init(online.split(key).init, setup)  # noqa: E731
        states = jax.jit(jax.vmap(one, (None, 0)), compiler_options=online.COMPILER_OPTIONS)(self.setup, self.keys)
        # no weak types: what is compiled fits a checkpoint
        return jax.tree.map(lambda leaf: leaf.astype(leaf.dtype), states)

    def compile(self, states: online.State) -> Callable[[online.State], tuple[online.State, online.RoundInfo]]:
        """One round of all seeds as compiled functions of their states, the same round that `online.run` does.

        What calls the target on the host is apart from what only computes, because programs with callbacks are not
        kept by the persistent compilation cache, and their traces are not kept either.
        """
        setup, thetas = self.setup, jax.numpy.asarray(self.hidden.at(1))
        keys = jax.vmap(online.split)(self.keys)

        def record(setup: online.Setup, keys: Any, thetas: Any, states: Any) -> Any:
            one = lambda k, theta, state: online.record(k, setup, self.target.replace(theta=theta), state)  # noqa: E731
            return _over_seeds(one, len(self.seeds))(keys, thetas, states)

        def evaluate(setup: online.Setup, keys: Any, thetas: Any, states: Any) -> Any:
            one = lambda k, theta, state: online.evaluate(k, setup, self.target.replace(theta=theta), state)  # noqa: E731
            return _over_seeds(one, len(self.seeds))(keys, thetas, states)

        def of_a_round(leaf: jax.Array) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((len(self.seeds), setup.recordings, *leaf.shape[2:]), leaf.dtype)

        seen = jax.tree.map(of_a_round, states.history)
        options = online.COMPILER_OPTIONS
        build = lambda f, *args: jax.jit(f, compiler_options=options).lower(*args)  # noqa: E731
        rounds = {bool(online.infers(setup, r)) for r in range(self.settings.rounds)}
        with ThreadPoolExecutor() as pool:  # the others are compiled while the last is traced
            evaluator = pool.submit(build(evaluate, setup, keys.evaluate, thetas, states).compile)
            recorder = (
                pool.submit(build(record, setup, keys.record, thetas, states).compile) if True in rounds else None
            )
            given = setup, keys.update, states
            improver = (
                pool.submit(compile_once, _improve, *given, compiler_options=options) if False in rounds else None
            )
            updater = compile_once(_update, *given, seen, compiler_options=options) if True in rounds else None

        def advance(states: online.State) -> tuple[online.State, online.RoundInfo]:
            thetas = jax.numpy.asarray(self.hidden.at(int(states.round[0]) + 1))
            if online.infers(setup, int(states.round[0])):
                assert recorder is not None and updater is not None
                recordings = recorder.result()(setup, keys.record, thetas, states)
                states, infos = updater(setup, keys.update, states, recordings)
            else:
                assert improver is not None
                states, infos = improver.result()(setup, keys.update, states)
            return states, infos.replace(**evaluator.result()(setup, keys.evaluate, thetas, states))

        return advance

    def sources(self) -> list[str]:
        """What the run builds on, as authors and year."""
        system: Any = self.setup.system
        effects = [type(w.effect) for w in getattr(getattr(system, "simulator", None), "effects", ())]
        return used_sources([online.init, online.run, online.Truncated, self.setup, *effects])


def _update(setup: online.Setup, keys: Any, states: online.State, recordings: Any) -> Any:
    """`online.update` of all seeds."""
    one = lambda k, state, seen: online.update(k, setup, state, seen)  # noqa: E731
    return _over_seeds(one, keys.shape[0])(keys, states, recordings)


def _improve(setup: online.Setup, keys: Any, states: online.State) -> Any:
    """`online.improve` of all seeds."""
    one = lambda k, state: online.improve(k, setup, state)  # noqa: E731
    return _over_seeds(one, keys.shape[0])(keys, states)


def make_plan(settings: Settings) -> Plan:
    """Build everything that the settings name; raises `UsageError` where they cannot be."""
    try:
        return _make_plan(settings)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _make_plan(settings: Settings) -> Plan:
    subject = find_subject(settings)
    entry, names = subject.entry, subject.box.names
    _check_names(settings.prior, names, "prior")
    system = entry.system(**settings.prior, noise=settings.noise)
    controller = entry.learner if settings.controller == "auto" else settings.controller
    planned = controller in control.PLANNERS
    if planned and entry.planned is None:
        raise ValueError(f"{settings.system} has no task that one can plan for; take --controller {entry.learner}.")
    if planned:
        _check_restart(system, controller, entry.learner)
    task = entry.planned() if planned and entry.planned else entry.task()
    box = system.parameters
    pace = dataclasses.asdict(Schedule()) | _checked(dataclasses.asdict(Schedule()), settings.schedule, "schedule")
    learner, habits = _learner(controller, settings, system, task)
    sizes = ("steps", "simulations", "recordings", "evaluations", "pool", "history", "calibrations", "kept")
    setup = online.Setup.create(
        system,
        learner,
        task,
        estimator=make_estimator(settings.encoder, system, settings.components, Schedule(**pace)),
        proposal=settings.proposal,
        replay=planned,
        forget=settings.forget,
        warmup=settings.warmup,
        inferences=INFERENCES[settings.scheme],
        components=settings.components,
        **{name: getattr(settings, name) for name in sizes},
    )
    seeds = list(range(settings.seed, settings.seed + settings.seeds))
    kind = _kind(settings, system)
    robot: Any = system
    vehicle = SkidSteerVehicle(robot) if kind == "vehicle" else None
    hidden = _hidden(settings, box, seeds, subject.truth, vehicle)
    target = _target(kind, settings, system, task, vehicle, hidden.at(1)[0], rescored=planned)
    complete = dataclasses.replace(
        settings,
        target=kind,
        controller=controller,
        calibrations=setup.calibrations,
        diagnosis=str(Path(settings.diagnosis).resolve()) if settings.diagnosis else "",
        prior={n: (_short(a), _short(b)) for n, a, b in zip(names, box.low, box.high, strict=True)},
        schedule=pace,
        learner={name: value for name, value in habits.items() if value is not None},
    )
    remarks = subject.remarks
    if setup.inferences and setup.warmup >= settings.rounds:
        remarks += (
            f"warmup is {setup.warmup} and rounds is {settings.rounds}: nothing is recorded or inferred; for that take "
            f"--rounds {setup.warmup + 1} or more.",
        )
    return Plan(complete, setup, target, seeds, hidden, remarks)


def _kind(settings: Settings, system: Any) -> str:
    """What the settings' target is called once it is chosen."""
    name, kind = settings.system, settings.target
    if kind == "auto":
        return "gymnasium" if name in GYMNASIUM else "simulated"
    if kind == "vehicle" and not isinstance(system, systems.SkidSteer):
        raise ValueError(f"the target vehicle is a skid-steered one; {name} has none: take another --target.")
    if kind == "gymnasium" and name not in GYMNASIUM:
        raise ValueError(f"Gymnasium has no environment for {name}; add --target simulated.")
    return kind


def _target(kind: str, settings: Settings, system: Any, task: Any, vehicle: Any, hidden: Any, *, rescored: bool) -> Any:
    if kind == "simulated":
        return SimulatedTarget(system, task, hidden)
    if kind == "vehicle":
        on_vehicle: Any = OnVehicle(task)
        return SimulatedTarget(vehicle, on_vehicle, hidden)
    target = gymnasium_target(settings.system, hidden, system.noise)
    return Rescored(target, system, task, hidden) if rescored else target


def make_estimator(encoder: str, system: Any, components: int = 5, schedule: Schedule | None = None) -> MixtureDensity:
    """What `--encoder` names, for recordings of this system."""
    if encoder == "fourier":
        return fourier_mixture(actions=system.actions.size, components=components, schedule=schedule)
    if encoder == "summary":
        return summary_mixture(actions=system.actions.size, components=components, schedule=schedule)
    return recurrent_mixture(encoder, components, schedule, features_of(system))


def _check_restart(system: Any, controller: str, learner: str) -> None:
    """Raise `ValueError` where a state cannot be made of what the sensors show."""
    theta, seen = system.parameters.low, system.observations.low
    try:
        jax.eval_shape(system.restart, theta, seen)
    except ValueError as error:
        raise ValueError(
            f"{controller} cannot plan: {str(error).rstrip('.')}; or take --controller {learner}."
        ) from error


def _hidden(
    settings: Settings,
    box: Box,
    seeds: list[int],
    usual: Float[np.ndarray, " d"] | None,
    vehicle: SkidSteerVehicle | None,
) -> Truths:
    """The hidden parameters of every seed: those given, the others as usual or drawn from the prior; then those of the
    vehicle's own; and what becomes of them.
    """
    every = box if vehicle is None else vehicle.parameters
    low, high = np.asarray(every.low), np.asarray(every.high)

    def placed(drawn: np.ndarray, given: Mapping[str, float], what: str) -> np.ndarray:
        _check_names(given, every.names, what)
        for i, name in enumerate(every.names):
            if name in given:
                drawn[:, i] = given[name]
                if not (low[i] <= drawn[:, i]).all() or not (drawn[:, i] <= high[i]).all():
                    range_, advice = (
                        ("the prior", " or widen [prior] in a config file") if i < box.size else ("its range", "")
                    )
                    raise ValueError(
                        f"{what} {name}={given[name]} lies outside {range_}, {_short(low[i])} to {_short(high[i])} "
                        f"{every.units[i]}".rstrip()
                        + f"; choose another{advice}."
                    )
        return drawn

    keys = [jax.random.fold_in(jax.random.key(seed), TRUTH) for seed in seeds]
    drawn = np.stack([np.array(box.low + jax.random.uniform(key, (box.size,)) * box.width) for key in keys])
    if usual is not None:
        drawn[:] = np.clip(usual, box.low, box.high)
    if vehicle is not None:
        drawn = np.array(jax.vmap(vehicle.theta)(jax.numpy.asarray(drawn)))
    changed = _numbers(settings.change, vehicle, "change")
    change = int(changed.pop("round")) if changed else None
    if change is not None and not changed:
        raise ValueError("change names no parameter; add one, such as --change round=10 NAME=NUMBER.")
    first = placed(drawn, _numbers(settings.truth, vehicle, "truth"), "truth")
    return Truths(first, placed(first.copy(), changed, "change"), change)


def _numbers(given: Mapping[str, float | str], vehicle: SkidSteerVehicle | None, what: str) -> dict[str, float]:
    """What is given, with the numbers that a terrain's name stands for; numbers beside it win."""
    numbers = {name: float(value) for name, value in given.items() if name != "terrain"}
    if "terrain" not in given:
        return numbers
    if vehicle is None:
        raise ValueError(f"{what}: only the vehicle drives on a terrain; add --target vehicle.")
    return {**find_named(str(given["terrain"]), TERRAINS, f"{what}: unknown terrain"), **numbers}


def _check_names(given: Iterable[str], known: Iterable[str], what: str) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"{what}: unknown parameter {name!r}: {near_miss(name, known)}")


def _learner(name: str, settings: Settings, system: Any, task: Any) -> tuple[Any, dict[str, Any]]:
    """The learner of a system with the values of a config table, and all its values."""
    if name in control.PLANNERS:
        create, makers = control.Planner.create, (control.Planner.create, control.Disco.create, control.Mppi.create)
        chosen = control.default_settings(name, settings.system) | {"components": settings.components}
    else:
        create = learning.LEARNERS[name].create
        makers = (create,)
        usual, habits = learning.DEFAULTS[settings.system]
        chosen = habits if usual == name else {}
    parameters = [p for maker in makers for p in inspect.signature(maker).parameters.values()]
    values = {p.name: p.default for p in parameters if p.default is not p.empty} | chosen
    values |= _checked(values, settings.learner, "learner")
    return create(system, task, **values), values


def _checked(values: Mapping[str, Any], changes: Mapping[str, Any], table: str) -> dict[str, Any]:
    """The values of a config table, each of the kind that it replaces."""
    checked = {}
    for name, new in changes.items():
        if name not in values:
            raise ValueError(f"[{table}]: unknown key {name!r}: {near_miss(name, values)}")
        old = values[name]
        whole = isinstance(old, int) and not isinstance(old, bool)
        kinds = (int,) if whole else (list, tuple) if isinstance(old, tuple) else (int, float)
        kinds = (str,) if isinstance(old, str) else kinds
        if type(new) not in kinds:
            wanted = "a whole number" if whole else "a list" if isinstance(old, tuple) else "a number"
            wanted = "a word" if isinstance(old, str) else wanted
            raise ValueError(f"[{table}]: {name} is {new!r}; it needs {wanted}.")
        checked[name] = tuple(new) if isinstance(old, tuple) else new
    return checked


def _short(value: Any) -> float:
    """A float32 as the decimal number that a person would write for it."""
    return float(str(np.float32(value)))


def _over_seeds(function: Callable[..., Any], seeds: int) -> Callable[..., Any]:
    """Map over a leading axis; a single seed is run unbatched, which costs less."""
    if seeds > 1:
        return jax.vmap(function)

    def alone(*arguments: Any) -> Any:
        result = function(*jax.tree.map(lambda leaf: leaf[0], arguments))
        return jax.tree.map(lambda leaf: leaf[None], result)

    return alone
