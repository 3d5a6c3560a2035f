"""Benchmarks: `python -m benchmarks NAME`."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from benchmarks.timing import CLOCKS, choose_clock

_MECHANISMS = ("pendulum", "cart-pole", "double pendulum", "3-joint arm", "6-joint arm")
_RIGS = ("pendulum", "swing", "pivot", "slide", "sled", "double", "chain", "servo", "cart", "arm3", "arm6")


def _part(text: str) -> tuple[int, int]:
    """`1/2` as numbers."""
    part, _, parts = text.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise argparse.ArgumentTypeError(f"{text!r} is not K/N with K from 1 to N")
    return int(part), int(parts)


def main() -> None:
    """Read the command line and run one benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)

    online = commands.add_parser("online", help="one round against Stable-Baselines3 and PyTorch")
    online.add_argument("--repeats", type=int, default=3)
    online.add_argument("--held-out", type=int, default=500)
    online.add_argument("--ladder", type=int, nargs="+", default=[10, 20, 40, 80, 200], help="epochs of our fit to try")
    online.add_argument("--encoder", default="pooled_lstm", help="of our fit to the same held-out log q")
    online.add_argument("--members", type=int, default=4, help="networks in the ensemble of that fit")
    _add_common(online)

    estimator = commands.add_parser("estimator", help="the estimator alone against sbi")
    estimator.add_argument("--repeats", type=int, default=1)
    estimator.add_argument("--train", type=int, default=1500)
    estimator.add_argument("--held-out", type=int, default=500)
    estimator.add_argument("--epochs", type=int, default=20)
    estimator.add_argument("--members", type=int, default=4, help="networks in our ensemble")
    estimator.add_argument("--encoders", nargs="+", default=["pooled_lstm"])
    estimator.add_argument("--models", nargs="+", default=["mdn", "maf"], help="sbi's density estimators")
    _add_common(estimator)

    scaling = commands.add_parser("scaling", help="rollouts per second and memory against batch size")
    scaling.add_argument("--largest", type=int, default=65_536)
    scaling.add_argument("--repeats", type=int, default=3)
    scaling.add_argument("--figure", type=Path, default=Path("docs/figures/scaling.svg"))

    engines = commands.add_parser("engines", help="steps per second against MuJoCo's C engine and MJX")
    engines.add_argument("--models", nargs="+", default=[*_MECHANISMS], choices=_MECHANISMS)
    engines.add_argument("--batches", type=int, nargs="+", default=[64, 256, 1024, 4096])
    engines.add_argument("--steps", type=int, default=200)
    engines.add_argument("--repeats", type=int, default=5)
    engines.add_argument("--mjx", type=int, default=1024, metavar="BATCH", help="batch of MJX; 0 leaves it out")

    fetch = commands.add_parser("fetch", help="Fetch Push against mujoco.rollout and Stable-Baselines3's HER")
    fetch.add_argument("--batch", type=int, default=64)
    fetch.add_argument("--steps", type=int, default=50)
    fetch.add_argument("--repeats", type=int, default=3)
    fetch.add_argument("--peer-steps", type=int, default=2000, help="of the peer's training; 0 leaves it out")

    concealed = commands.add_parser("concealed", help="diagnoses of machines with effects concealed in them")
    concealed.add_argument(
        "--rigs", nargs="+", choices=_RIGS, help="machines; those without contacts and with motors if left out"
    )
    _add_cases(concealed, 200, seed=1)
    _add_part(concealed)
    concealed.add_argument(
        "--records", type=Path, nargs="+", help="files of cases: print what became of one, or a table of several"
    )
    concealed.add_argument("--peers", action="store_true", help="name them by sparse regression (PySINDy), too")

    strangers = commands.add_parser(
        "strangers", help="diagnoses of machines of another kind, simulated as anyone would"
    )
    _add_cases(strangers, 60, seed=1)
    _add_part(strangers)

    identification = commands.add_parser("identification", help="posteriors of simulated machines against mujoco.sysid")
    identification.add_argument(
        "--rigs", nargs="+", choices=_RIGS, help="machines; five of one to three joints if left out"
    )
    _add_cases(identification, 50, seed=0)
    identification.add_argument("--finer", type=int, default=4, help="times that the machines' time step is shorter")
    identification.add_argument("--method", choices=("direct", "amortised", "laplace"), default="direct")
    identification.add_argument("--beside", type=Path, help="such a file of another method, to compare with")

    thresholds = commands.add_parser("thresholds", help="diagnoses with the whole family of the effect left out")
    thresholds.add_argument(
        "--rigs", nargs="+", choices=_RIGS, help="machines; those of one and two joints if left out"
    )
    _add_cases(thresholds, 60)
    thresholds.add_argument(
        "--records", type=Path, nargs="+", help="of `concealed`: hold the answers in them against this"
    )

    mppi = commands.add_parser("mppi", help="a control step of DISCO on the pendulum against pytorch_mppi")
    mppi.add_argument("--repeats", type=int, default=7)
    mppi.add_argument("--out", type=Path, help="file of JSON lines for what is timed; if it is there, it is printed")
    mppi.add_argument("--figure", type=Path, help="of the time of a step over samples and horizon")
    _add_common(mppi)

    for command in (online, estimator, scaling, engines, fetch, mppi):
        command.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: seconds summed over threads")

    options = parser.parse_args()
    if options.command == "concealed":
        from benchmarks.concealed import diagnose_concealed

        diagnose_concealed(options)
        return
    if options.command == "strangers":
        from benchmarks.strangers import diagnose_strangers

        diagnose_strangers(options)
        return
    if options.command == "identification":
        from benchmarks.identification import identify_clean

        identify_clean(options)
        return
    if options.command == "thresholds":
        from benchmarks.thresholds import leave_families_out

        leave_families_out(options)
        return
    choose_clock(options.clock)
    if options.command == "online":
        from benchmarks.online import compare_rounds

        compare_rounds(options)
    elif options.command == "estimator":
        from benchmarks.estimator import compare_estimators

        compare_estimators(options)
    elif options.command == "mppi":
        from benchmarks.mppi import compare_planners

        compare_planners(options)
    elif options.command == "engines":
        _use_all_cores()
        from benchmarks.engines import compare_engines

        compare_engines(options)
    elif options.command == "fetch":
        from benchmarks.fetch import compare_fetch

        compare_fetch(options)
    else:
        from benchmarks.scaling import measure_scaling

        measure_scaling(options)


def _use_all_cores() -> None:
    """One JAX device for each processor, as the tree engine's batches are spread."""
    import jax

    jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="PyTorch threads; 0 takes the faster of 1 and all cores")


def _add_cases(parser: argparse.ArgumentParser, count: int, seed: int | None = None) -> None:
    parser.add_argument("--cases", type=int, default=count)
    if seed is not None:
        parser.add_argument("--seed", type=int, default=seed)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append cases to, and to resume from")


def _add_part(parser: argparse.ArgumentParser) -> None:
    told = "every Nth case from the Kth on; one core each"
    parser.add_argument("--part", type=_part, default=(1, 1), metavar="K/N", help=told)


if __name__ == "__main__":
    main()
