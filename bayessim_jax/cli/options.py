"""What the commands can be told: frozen dataclasses, the only schema of flags and of `config.toml`.

Nothing here imports JAX, so that help and bad usage are answered at once.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["DIAGNOSED", "HABITS", "Online", "Settings"]


def _pairs(words: list[str]) -> dict[str, float]:
    return {name: _number(name, value, word) for word in words for name, _, value in [word.partition("=")]}


def _hidden(words: list[str]) -> dict[str, float | str]:
    return {
        name: value if name == "terrain" and value else _number(name, value, word)
        for word in words
        for name, _, value in [word.partition("=")]
    }


def _number(name: str, value: str, word: str) -> float:
    try:
        if name:
            return float(value)
    except ValueError:
        pass
    raise ValueError(f"{word!r} is not of the form NAME=NUMBER, such as length=0.5")


def _table(instance_from_str: Callable[[list[str]], dict[str, Any]], metavar: str) -> Any:
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar=metavar,
        instance_from_str=instance_from_str,
        is_instance=lambda x: isinstance(x, dict),
        str_from_instance=lambda x: [f"{name}={value}" for name, value in x.items()],
    )


Pairs = Annotated[dict[str, float], _table(_pairs, "NAME=NUMBER ...")]
Hidden = Annotated[dict[str, float | str], _table(_hidden, "NAME=NUMBER ...")]
"""Hidden parameters; a vehicle's `terrain` is a word."""
Run = Annotated[
    str,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="RUN",
        instance_from_str=lambda words: str(Path(words[0]).resolve()),
        is_instance=lambda x: isinstance(x, str),
        str_from_instance=lambda x: [x],
    ),
    tyro.conf.arg(name="from"),
]
"""A run folder, kept as an absolute path: a run is continued from anywhere."""
COUNTS = ("rounds", "seeds", "steps", "recordings", "pool", "history", "components")
LEAST = {
    **dict.fromkeys(COUNTS, 1),
    "simulations": 10,
    "seed": 0,
    "evaluations": 0,
    "calibrations": 0,
    "kept": 0,
    "warmup": 0,
    "noise": 0.0,
    "forget": 0.0,
}
FETCH = {
    "noise": 0.001,
    "encoder": "attention",
    "warmup": 3,
    "evaluations": 10,
    "history": 16,
    "calibrations": 64,
    "kept": 64,
}
DIAGNOSED = "diagnosed"
"""The system of a run that has its simulator from a diagnosis."""
HABITS: dict[str, dict[str, Any]] = {
    DIAGNOSED: {"scheme": "uniform", "noise": 0.0, "evaluations": 4, "history": 8, "calibrations": 64},
    "hopper": {"rounds": 50, "history": 8, "calibrations": 64},
    "fetch_push": FETCH,
    "fetch_slide": FETCH,
}
"""Defaults that differ where a system asks for it: simulations with contacts cost more, and Fetch is seen in metres.
What a diagnosis repaired is known already: domain randomization over its posterior, with the noise that it found."""


@dataclass(frozen=True)
class Settings:
    """Everything that decides what a run computes; what `config.toml` holds."""

    system: tyro.conf.Positional[
        Literal["cartpole", "pendulum", "acrobot", "skid_steer", "hopper", "fetch_push", "fetch_slide", "diagnosed"]
    ]
    """What to identify and control; see `bayessim systems`. With --from it is left out."""
    diagnosis: Run = ""
    """Run folder of bayessim diagnose: train on the simulator that it repaired, over its posterior."""
    goal: Pairs = field(default_factory=dict)
    """With --from: the pose to bring joints to and hold, such as joint/elbow=1.0 (rad or m); joints that are not named
    are held at the median of their recorded positions."""
    target: Literal["auto", "gymnasium", "simulated", "vehicle"] = "auto"
    """The machine with hidden parameters: Gymnasium's environment, this package's own system, or for skid_steer a
    vehicle with late wheels that slip; auto is Gymnasium's where there is one, and the package's own elsewhere."""
    controller: Literal["auto", "ppo", "sac", "her", "mppi", "disco"] = "auto"
    """What acts: a policy that is trained, or a planner: mppi plans under the mean of the belief, disco under the
    belief; auto takes what suits the system."""
    truth: Hidden = field(default_factory=dict)
    """True parameters to hide in the target; those not given are drawn from the prior by the seed, and with --from
    they are the posterior's mean. The vehicle has more: slip, turning_slip, looseness and lag, or the first three by
    terrain=yard, asphalt, gravel or ice."""
    change: Hidden = field(default_factory=dict)
    """Other true parameters from a round on, such as round=10 length=0.8, or terrain=ice for the vehicle: what is not
    named stays as it was."""
    forget: float = 0.0
    """Probability that the true parameters change between two rounds; above 0 the belief follows a change."""
    scheme: Literal["online", "offline", "uniform"] = "online"
    """When to infer: in every round; once, from the policy after the warm-up, and then keep that posterior; or never,
    which is domain randomization over the prior."""
    warmup: int = 0
    """Rounds before the first recording, in which the policy improves against the prior."""
    rounds: int = 30
    """Rounds of the outer loop, warm-up included."""
    seed: int = 0
    """Seed of everything random; with several seeds, the first of them."""
    seeds: int = 1
    """Runs at once, each with its own seed and truth, to show the spread."""
    encoder: Literal["pooled_lstm", "lstm", "attention", "fourier", "summary"] = "pooled_lstm"
    """How a recording is read: a fast LSTM over pooled frames, the paper's LSTM, transitions averaged with weights that
    are learned, or hand-made summaries with and without random Fourier features (the BayesSim RFF and epsilon-free
    baselines)."""
    proposal: Literal["corrected", "paper", "truncated"] = "truncated"
    """Where to simulate in the next round: from the prior, on an ellipsoid around the belief (truncated); where the
    paper does; or from a Gaussian around the belief, which is divided out again (corrected)."""
    simulations: int = 200
    """Parameters simulated in a round."""
    steps: int = 50
    """Steps of a recording, real or simulated."""
    recordings: int = 1
    """Recordings of the target in a round."""
    evaluations: int = 1
    """Full episodes on the target that judge the policy after each round; 0 for none."""
    pool: int = 10
    """Rounds whose simulations are kept for the fit."""
    history: int = 32
    """Recordings of the target that are remembered; the posterior is conditioned on all of them."""
    calibrations: int = 0
    """Sets of recordings simulated in a round, to learn the posterior of a set from and to calibrate it; 0 for as many
    as make 32768 recordings, from 1024 to 4096."""
    kept: int = 0
    """Of these sets, how many at most join the simulations that the networks are fitted to from the next round on."""
    components: int = 5
    """Gaussians in the posterior."""
    noise: float = 0.01
    """Standard deviation of the sensor noise, in each channel's unit; with --from it is added to what the diagnosis
    found."""
    prior: tyro.conf.Suppress[dict[str, tuple[float, float]]] = field(default_factory=dict)
    schedule: tyro.conf.Suppress[dict[str, Any]] = field(default_factory=dict)
    learner: tyro.conf.Suppress[dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse numbers that no run could use."""
        for name, least in LEAST.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be {least} or more.")
        if not self.forget < 1:
            raise ValueError(f"forget is {self.forget}; it is a probability, from 0 to below 1.")
        for table, hidden in (("truth", self.truth), ("change", self.change)):
            for name, value in hidden.items():
                if isinstance(value, str) and name != "terrain":
                    raise ValueError(f"{table}.{name} is {value!r}; it needs a number.")
        if self.change and not ((when := float(self.change.get("round", 0))) >= 2 and when % 1 == 0):
            raise ValueError("change needs the round from which it holds, 2 or more, such as round=10 length=0.8.")
        if self.change and float(self.change["round"]) > self.rounds:
            raise ValueError(f"change holds from round {self.change['round']:g}, but rounds is {self.rounds}.")
        if self.seed + self.seeds > 2**32:
            raise ValueError(f"seed is {self.seed}; it must be below {2**32 - self.seeds + 1}.")
        for name, (low, high) in self.prior.items():
            if not low < high:
                raise ValueError(f"prior of {name}: low {low} must be below high {high}; swap or widen the bounds.")

    def tables(self) -> dict[str, Any]:
        """Plain tables for TOML and JSON."""
        return {
            key: {k: list(v) if isinstance(v, tuple) else v for k, v in value.items()}
            if isinstance(value, dict)
            else value
            for key, value in dataclasses.asdict(self).items()
        }


@dataclass(frozen=True)
class Online:
    """Learn a system's parameters and its controller together, round by round, against a target that hides them."""

    settings: tyro.conf.OmitArgPrefixes[Settings]
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """TOML file of settings, such as the config.toml of an earlier run; flags win over it. Its tables [prior],
    [schedule] and [learner] reach what has no flag."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the results; by default runs/SYSTEM-seedS; SYSTEM is the diagnosis' folder with --from."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in the output folder; more --rounds than before go on further."""
    quiet: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print nothing but errors."""

    @property
    def folder(self) -> Path:
        """Where the results go."""
        name = Path(self.settings.diagnosis).name or self.settings.system
        return self.out or Path("runs") / f"{name}-seed{self.settings.seed}"
