"""Traces are found again for what is the same in every process, and for nothing else."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs.margins import Margins, uniform
from bayessim_jax.contracts import Box
from bayessim_jax.diagnosis.bench import Simulator
from bayessim_jax.effects import EFFECTS, Scales
from bayessim_jax.inference.fit import FitInfo
from bayessim_jax.inference.replay import Replay
from bayessim_jax.programs import Unnamed, compile_once, keep_traces_in, name_of, trace_once
from bayessim_jax.systems.mjcf import Unknown, mjcf_system

MODEL = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="hinge" axis="0 1 0"/><inertial pos="0 0 -0.2" mass="{mass}" diaginertia="0.004 0.004 0.001"/>
</body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>"""
TRACED = []


@pytest.fixture
def folder(tmp_path):
    keep_traces_in(tmp_path)
    TRACED.clear()
    yield tmp_path
    keep_traces_in(None)


def grow(x, power, more):
    """Of the package as far as names are concerned."""
    TRACED.append(power)
    return x**power + more["a"], x.sum()


grow.__module__ = "bayessim_jax.elsewhere"


def test_a_trace_is_taken_from_the_disk(folder):
    given = np.arange(3.0, dtype=np.float32), 2, {"a": np.float32(1.0)}
    first = trace_once(grow, static_argnames="power")(*given)
    assert TRACED == [2]
    again = trace_once(grow, static_argnames="power")
    for found in (first, again(*given), again(given[0], more=given[2], power=2)):
        np.testing.assert_array_equal(found[0], [1.0, 2.0, 5.0])
        assert float(found[1]) == 3.0
    assert TRACED == [2]
    assert len(list(folder.iterdir())) == 1
    again(given[0], 3, given[2])
    again(np.arange(4.0, dtype=np.float32), 3, given[2])
    assert TRACED == [2, 3, 3]


def test_a_file_that_cannot_be_read_is_made_again(folder):
    given = np.arange(3.0, dtype=np.float32), 2, {"a": np.float32(1.0)}
    trace_once(grow, static_argnames="power")(*given)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    np.testing.assert_array_equal(trace_once(grow, static_argnames="power")(*given)[0], [1.0, 2.0, 5.0])
    assert TRACED == [2, 2]
    assert len(file.read_bytes()) == len(whole)


def test_what_is_returned_takes_part_in_other_programs_as_ever(folder):
    after = jax.jit(lambda x: x + 1)
    y = trace_once(grow, static_argnames="power")(jnp.arange(3.0), 2, {"a": 1.0})[0]
    after(y)
    after(jax.jit(lambda x: 2 * x)(jnp.arange(3.0)))
    assert after._cache_size() == 1


def test_functions_of_others_are_traced_as_ever(folder):
    def own(x):
        return 2 * x, x

    keeping = trace_once(own)
    np.testing.assert_array_equal(keeping(jnp.ones(2))[0], [2.0, 2.0])
    called = trace_once(grow, static_argnames="power")
    np.testing.assert_array_equal(called(jnp.ones(2), 1, {"a": 0.0})[0], [1.0, 1.0])
    assert jax.vmap(lambda x: called(x, 1, {"a": 0.0})[1])(jnp.ones((3, 2))).shape == (3,)
    assert len(list(folder.iterdir())) == 1


def test_calls_into_python_are_not_kept(folder):
    def asks(x):
        return (jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct(x.shape, x.dtype), x),)

    asks.__module__, asks.__qualname__ = "bayessim_jax.elsewhere", "asks"
    np.testing.assert_array_equal(trace_once(asks)(jnp.ones(2))[0], [2.0, 2.0])
    assert not list(folder.iterdir())


def simulators():
    """The same simulator twice, with other ranges, and others."""
    margins = Margins.create(["mass"], [uniform(0.1, 1.0)])
    unknown = [Unknown("mass", ("body/body/mass",), 0.1, 1.0)]

    def make(effect="coulomb_friction", mass=0.5, low=0.1, force=1.0):
        model = MODEL.format(mass=mass).replace("<body>", '<body name="body">')
        pairs = ((EFFECTS[effect], "joint/hinge"),)
        own = Margins.create(["mass"], [uniform(low, 1.0)]) if low != 0.1 else margins
        return Simulator(mjcf_system(model, unknown), own, pairs, {"joint/hinge": Scales(force=force)}, ())

    return make(), make(force=2.0), [make("viscous_friction"), make(mass=0.6), make(low=0.2)]


def test_names_follow_what_makes_simulators_equal():
    one, same, others = simulators()
    assert one == same
    assert name_of(one) == name_of(same)
    assert len({name_of(x) for x in (one, *others)}) == 4
    assert name_of(Replay(one.system, one.margins)) != name_of(one)


def test_names_are_the_same_in_every_process():
    code = "from tests.test_programs import *; print(name_of(simulators()[0]))"
    environment = dict(os.environ, PYTHONHASHSEED="7")
    root = Path(__file__).parents[1]
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, env=environment)
    assert run.stdout.strip() == name_of(simulators()[0]), run.stderr


@pytest.mark.parametrize("value", [object(), lambda: 0, jax.random.key(0), Path("x"), np.array([object()])])
def test_what_another_process_would_not_recognize_has_no_name(value):
    with pytest.raises(Unnamed):
        name_of((1, [value]))


def test_pieces_do_not_run_into_each_other():
    values = [("ab", "c"), ("a", "bc"), ["ab", "c"], (1, 2.0), (1.0, 2), (True, 2), (("ab",), "c"), {"ab": "c"}, None]
    assert len({name_of(value) for value in values}) == len(values)
    assert name_of(np.zeros(4)) != name_of(np.zeros((2, 2))) != name_of(np.zeros(4, np.float32))


def kept_pair(x, state):
    """What a round returns: a state as it came, and containers of the package's own."""
    TRACED.append(1)
    info = FitInfo(*(x.sum() * k for k in range(6)))
    return {**state, "a": state["a"] + 1}, (info, Box(x, x + 1, ("one",), ("m",)))


kept_pair.__module__ = "bayessim_jax.elsewhere"


def test_a_program_is_compiled_from_a_trace_on_the_disk_and_returns_what_it_did(folder):
    given = jnp.ones(1), {"a": jnp.zeros(2), "f": jnp.ones(3)}
    first = compile_once(kept_pair, *given)(*given)
    again = compile_once(kept_pair, *jax.eval_shape(lambda *x: x, *given))(*given)
    assert TRACED == [1]
    assert type(again[1][0]) is FitInfo and again[1][1].names == ("one",)
    for a, b, c in zip(*map(jax.tree.leaves, (first, again, kept_pair(*given))), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_no_class_from_elsewhere_is_taken_from_a_file(folder):
    given = jnp.ones(1), {"a": jnp.zeros(2), "f": jnp.ones(3)}
    compile_once(kept_pair, *given)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    ours, theirs = b"bayessim_jax.inference.fit.FitInfo", b"collections.abc.defaultdict1234567"
    assert len(ours) == len(theirs) and whole.count(ours) == 1
    file.write_bytes(whole.replace(ours, theirs))
    compile_once(kept_pair, *given)
    assert TRACED == [1, 1]
    assert ours in file.read_bytes()
