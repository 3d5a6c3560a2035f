"""From settings to what the loop needs: the set-up, the target with its hidden truth, one run for each seed."""

from __future__ import annotations

import dataclasses
import inspect
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from bayessim_jax import learning, online, systems
from bayessim_jax.cli.citations import used_sources
from bayessim_jax.cli.options import Settings
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.contracts import Box
from bayessim_jax.engines.gymnasium import GYMNASIUM, gymnasium_target
from bayessim_jax.engines.simulated import SimulatedTarget
from bayessim_jax.inference.estimators import fourier_mixture, recurrent_mixture, summary_mixture
from bayessim_jax.inference.fit import Schedule
from bayessim_jax.spelling import near_miss

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

__all__ = ["Plan", "make_plan"]

TRUTH = 0x7275
INFERENCES = {"online": online.FOREVER, "offline": 1, "uniform": 0}


@dataclass(frozen=True)
class Plan:
    """A run, ready to go. `settings` are complete: every prior, schedule and learner number is in them."""

    settings: Settings
    setup: online.Setup
    target: Any
    seeds: list[int]
    truths: Float[np.ndarray, "seed d"]

    @property
    def keys(self) -> jax.Array:
        """One key for each seed."""
        return jax.vmap(jax.random.key)(np.asarray(self.seeds, np.uint32))

    def start(self) -> online.State:
        """The state of every seed before the first round, with a leading axis over the seeds."""
        one = lambda setup, key: online.init(online.split(key).init, setup)  # noqa: E731
        states = jax.jit(jax.vmap(one, (None, 0)))(self.setup, self.keys)
        # no weak types: what is compiled fits a checkpoint
        return jax.tree.map(lambda leaf: leaf.astype(leaf.dtype), states)

    def compile(self, states: online.State) -> Callable[[online.State], tuple[online.State, online.RoundInfo]]:
        """One round of all seeds as compiled functions of their states, the same round that `online.run` does.

        What calls the target on the host is apart from what only computes, because programs with callbacks are not
        kept by the persistent compilation cache.
        """
        setup, thetas = self.setup, jax.numpy.asarray(self.truths)
        keys = jax.vmap(online.split)(self.keys)

        def record(setup: online.Setup, keys: Any, thetas: Any, states: Any) -> Any:
            one = lambda k, theta, state: online.record(k, setup, self.target.replace(theta=theta), state)  # noqa: E731
            return _over_seeds(one, len(self.seeds))(keys, thetas, states)

        def update(setup: online.Setup, keys: Any, states: Any, recordings: Any) -> Any:
            one = lambda k, state, seen: online.update(k, setup, state, seen)  # noqa: E731
            return _over_seeds(one, len(self.seeds))(keys, states, recordings)

        def improve(setup: online.Setup, keys: Any, states: Any) -> Any:
            one = lambda k, state: online.improve(k, setup, state)  # noqa: E731
            return _over_seeds(one, len(self.seeds))(keys, states)

        def evaluate(setup: online.Setup, keys: Any, thetas: Any, states: Any) -> Any:
            one = lambda k, theta, state: online.evaluate(k, setup, self.target.replace(theta=theta), state)  # noqa: E731
            return _over_seeds(one, len(self.seeds))(keys, thetas, states)

        seen = jax.eval_shape(record, setup, keys.record, thetas, states)
        build = lambda f, *args: jax.jit(f, compiler_options=online.COMPILER_OPTIONS).lower(*args)  # noqa: E731
        rounds = {bool(online.infers(setup, r)) for r in range(self.settings.rounds)}
        with ThreadPoolExecutor() as pool:  # the others are compiled while the last is traced
            evaluator = pool.submit(build(evaluate, setup, keys.evaluate, thetas, states).compile)
            recorder = (
                pool.submit(build(record, setup, keys.record, thetas, states).compile) if True in rounds else None
            )
            improver = pool.submit(build(improve, setup, keys.update, states).compile) if False in rounds else None
            updater = build(update, setup, keys.update, states, seen).compile() if True in rounds else None

        def advance(states: online.State) -> tuple[online.State, online.RoundInfo]:
            if online.infers(setup, int(states.round[0])):
                assert recorder is not None and updater is not None
                recordings = recorder.result()(setup, keys.record, thetas, states)
                states, infos = updater(setup, keys.update, states, recordings)
            else:
                assert improver is not None
                states, infos = improver.result()(setup, keys.update, states)
            returned, success = evaluator.result()(setup, keys.evaluate, thetas, states)
            return states, infos.replace(return_target=returned, success_target=success)

        return advance

    def sources(self) -> list[str]:
        """What the run builds on, as authors and year."""
        return used_sources([online.init, online.run, online.Truncated, self.setup])


def make_plan(settings: Settings) -> Plan:
    """Build everything that the settings name; raises `UsageError` where they cannot be."""
    try:
        return _make_plan(settings)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _make_plan(settings: Settings) -> Plan:
    entry = systems.lookup(settings.system)
    if settings.target == "gymnasium" and settings.system not in GYMNASIUM:
        raise ValueError(f"Gymnasium has no environment for {settings.system}; add --target simulated.")
    names = entry.system().parameters.names
    _check_names(settings.prior, names, "prior")
    system = entry.system(**settings.prior, noise=settings.noise)
    task = entry.task()
    box = system.parameters
    pace = dataclasses.asdict(Schedule()) | _checked(dataclasses.asdict(Schedule()), settings.schedule, "schedule")
    learner, habits = _learner(settings.system, system, task, settings.learner)
    sizes = ("steps", "simulations", "recordings", "evaluations", "pool", "history", "calibrations", "components")
    setup = online.Setup.create(
        system,
        learner,
        task,
        estimator=_estimator(settings, system.actions.size, Schedule(**pace)),
        proposal=settings.proposal,
        warmup=settings.warmup,
        inferences=INFERENCES[settings.scheme],
        **{name: getattr(settings, name) for name in sizes},
    )
    seeds = list(range(settings.seed, settings.seed + settings.seeds))
    truths = np.stack([_truth(settings, box, seed) for seed in seeds])
    if settings.target == "simulated":
        target = SimulatedTarget(system, task, truths[0])
    else:
        target = gymnasium_target(settings.system, truths[0], system.noise)
    complete = dataclasses.replace(
        settings,
        prior={n: (_short(a), _short(b)) for n, a, b in zip(names, box.low, box.high, strict=True)},
        schedule=pace,
        learner={name: value for name, value in habits.items() if value is not None},
    )
    return Plan(complete, setup, target, seeds, truths)


def _estimator(settings: Settings, actions: int, schedule: Schedule) -> Any:
    if settings.encoder == "fourier":
        return fourier_mixture(actions=actions, components=settings.components, schedule=schedule)
    if settings.encoder == "summary":
        return summary_mixture(actions=actions, components=settings.components, schedule=schedule)
    return recurrent_mixture(settings.encoder, settings.components, schedule)


def _truth(settings: Settings, box: Box, seed: int) -> Float[np.ndarray, " d"]:
    """The hidden parameters of a seed: those given, the others drawn from the prior."""
    _check_names(settings.truth, box.names, "truth")
    key = jax.random.fold_in(jax.random.key(seed), TRUTH)
    drawn = np.array(box.low + jax.random.uniform(key, (box.size,)) * box.width)
    low, high = np.asarray(box.low), np.asarray(box.high)
    for i, name in enumerate(box.names):
        if name in settings.truth:
            drawn[i] = settings.truth[name]
            if not low[i] <= drawn[i] <= high[i]:
                raise ValueError(
                    f"truth {name}={settings.truth[name]} lies outside the prior, {_short(low[i])} to "
                    f"{_short(high[i])} {box.units[i]}; choose another or widen [prior] in a config file."
                )
    return drawn


def _check_names(given: Iterable[str], known: Iterable[str], what: str) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"{what}: unknown parameter {name!r}: {near_miss(name, known)}")


def _learner(system_name: str, system: Any, task: Any, changes: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The learner of a system with the values of a config table, and all its values."""
    name, chosen = learning.DEFAULTS[system_name]
    create = learning.LEARNERS[name].create
    parameters = inspect.signature(create).parameters.values()
    values = {p.name: p.default for p in parameters if p.default is not p.empty} | chosen
    values |= _checked(values, changes, "learner")
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
        if type(new) not in kinds:
            wanted = "a whole number" if whole else "a list" if isinstance(old, tuple) else "a number"
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
