"""Candidates simulated: their numbers, their fits, and what one of them begins from."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.diagnosis.bench import Candidate, margin_of_effect
from bayessim_jax.diagnosis.finals import (
    _folds,
    _foresee,
    _log_share,
    _stand_ins,
    _with_numbers_of,
)
from bayessim_jax.diagnosis.problem import Problem
from bayessim_jax.diagnosis.procedure import detect
from bayessim_jax.diagnosis.response import Motion
from bayessim_jax.diagnosis.screen import Begun
from bayessim_jax.diagnosis.search import _turn, varied
from bayessim_jax.diagnosis.verdict import error_left
from bayessim_jax.effects import EFFECTS, EffectParameter, Scales
from bayessim_jax.inference.arrow import normal_equations
from bayessim_jax.inference.direct import estimate_noise
from bayessim_jax.inference.replay import replay_window
from bayessim_jax.inference.shooting import predict_all, solve
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.shots import case_model
from benchmarks.worlds import make_case

PAIRS = (
    ("coulomb_friction", "joint/hinge"),
    ("stribeck_friction", "joint/hinge"),
    ("actuator_delay", "actuator/motor"),
    ("actuator_saturation", "actuator/motor"),
    ("armature", "joint/hinge"),
)


def pose(case, named):
    """The problem that the two recordings of a case make, with effects that may be missing."""
    model = case_model(load_case(case).check(), before=0.04)
    windows = model.windows([0, 1])
    inputs = model.inputs(windows)
    scales = {place: Scales(timestep=0.002, period=0.004, duration=2.0) for _, place in named}
    return Problem(
        model.system,
        model.margins,
        tuple((EFFECTS[name], place) for name, place in named),
        scales,
        model.shots(windows),
        windows.recording,
        Motion(
            jnp.asarray(windows.qpos),
            jnp.asarray(windows.qvel),
            inputs.ctrl,
            inputs.past,
            inputs.time,
        ),
    )


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    jax.config.update("jax_enable_x64", True)
    folder = tmp_path_factory.mktemp("bench") / "rig"
    make_case(folder, "pendulum", "coulomb_friction", seed=3, recordings=2, seconds=2.0)
    yield pose(folder, PAIRS)
    jax.config.update("jax_enable_x64", False)


def test_a_moment_is_found_from_the_end_of_a_window_too(problem, tmp_path):
    """Where a fit has no slope: later than that, what changes lies in the next window, and earlier in the last row."""
    sealed = make_case(tmp_path / "drop", "slide", "gain_drop", strength=0.4, seed=4, recordings=2, seconds=2.0)
    true = sealed["effects"][0]["parameters"]
    screen = pose(tmp_path / "drop", [("gain_drop", "actuator/motor")]).screen(
        [(EFFECTS["gain_drop"], "actuator/motor")]
    )
    nothing = screen.begin(jnp.zeros(screen.d), jnp.array([0.01, 0.1]))
    margins, d = screen.scene.margin[0], screen.d
    for end in (0.5 * np.floor(true["time"] / 0.5), 0.5 * np.ceil(true["time"] / 0.5)):
        p = np.array(nothing.p)
        p[d : d + 2] = margins[0].standard(end), margins[1].standard(0.8)
        begun = Begun(Candidate((0,)), [(p, nothing.delta)], 0.0)
        found = screen.finish_candidate(begun, nothing)
        values = [float(m.value(float(z))) for m, z in zip(margins, found.p[d : d + 2], strict=True)]
        assert values == [pytest.approx(true["time"], abs=0.02), pytest.approx(true["gain"], abs=0.1)]


def test_a_push_is_found_from_where_a_window_begins(problem, tmp_path):
    """Earlier than that its beginning lies in another window, and that had no push at all."""
    sealed = make_case(tmp_path / "push", "cart", "disturbance_event", strength=0.2, seed=8, recordings=2, seconds=2.0)
    true, place = sealed["effects"][0]["parameters"], sealed["effects"][0]["at"]
    screen = pose(tmp_path / "push", [("disturbance_event", place)]).screen([(EFFECTS["disturbance_event"], place)])
    nothing = screen.begin(jnp.zeros(screen.d), jnp.array([0.01, 0.01, 0.1, 0.1]))
    margins, d = screen.scene.margin[0], screen.d
    p = np.array(nothing.p)
    begin = (0.5 * np.floor(true["start"] / 0.5) - 0.02, true["end"], 0.7 * true["impulse"])
    p[d : d + 3] = [m.standard(value) for m, value in zip(margins, begin, strict=True)]
    found = screen.finish_candidate(Begun(Candidate((0,)), [(p, nothing.delta)], 0.0), nothing)
    values = [float(m.value(float(z))) for m, z in zip(margins, found.p[d : d + 3], strict=True)]
    assert values[:2] == [pytest.approx(true["start"], abs=0.06), pytest.approx(true["end"], abs=0.06)]


@pytest.mark.parametrize("name", ["sensor_offset", "sensor_delay"])
def test_the_screen_knows_what_a_sensors_error_changes_in_the_first_state_too(problem, name):
    place = "joint/hinge/qpos"
    scene = dataclasses.replace(problem, scales={place: Scales(timestep=0.002, period=0.004)}).screen(
        [(EFFECTS[name], place)]
    )
    scene = scene.scene
    free, sigma = Candidate((0,)), jnp.ones(len(problem.system.channels))
    p = np.zeros(scene.d + scene.slots)
    still = jnp.zeros((len(scene.motion.start), 2))

    def residuals(x):
        moved = p.copy()
        moved[scene.d] = x
        return scene.expand(free, moved, still, sigma)

    here, slopes = residuals(0.0)
    slope = np.asarray(slopes)[:, scene.d].reshape(here.shape)
    beside = (np.asarray(residuals(1e-4)[0]) - np.asarray(residuals(-1e-4)[0])) / 2e-4
    np.testing.assert_allclose(-slope, beside, atol=0.1 * np.abs(beside).max())


@pytest.mark.parametrize("effects", [(0,), (1, 2), (2,)])
def test_normal_equations_are_those_of_all_derivatives(problem, effects):
    place = "joint/hinge/qpos"
    scales = problem.scales | {place: Scales(timestep=0.002, period=0.004)}
    pairs = [*problem.pairs[:2], (EFFECTS["sensor_offset"], place)]
    scene = dataclasses.replace(problem, scales=scales).screen(pairs).scene
    rng = np.random.default_rng(0)
    sigma = jnp.full(len(problem.system.channels), 0.1)
    candidate, p = Candidate(effects), np.zeros(scene.d + scene.slots)
    p[: scene.d + scene.count(candidate)] = 0.1 * rng.normal(size=scene.d + scene.count(candidate))
    delta = jnp.asarray(0.1 * rng.normal(size=(len(scene.motion.start), 2)) * np.asarray(scene.shots.spread))
    curvature, r = scene.assess(candidate, p, delta, sigma)
    seen, slopes = scene.expand(candidate, p, delta, sigma)
    np.testing.assert_allclose(r, seen, atol=1e-12)
    asked = normal_equations(seen.reshape(len(seen), -1), slopes, jnp.asarray(p), delta / scene.shots.spread)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), curvature, asked)


def has_the_slopes_of_differences(scene, candidate):
    p, count = np.zeros(scene.d + scene.slots), scene.count(candidate)
    p[scene.d : scene.d + count] = 0.3 * np.random.default_rng(0).normal(size=count)
    sigma, still = jnp.full(len(scene.system.channels), 0.1), jnp.zeros((len(scene.motion.start), 2))
    here, slopes = scene.expand(candidate, p, still, sigma)
    for k in range(scene.d, scene.d + count):
        ahead, behind = (
            scene.expand(candidate, p + e * (np.arange(p.size) == k), still, sigma)[0] for e in (1e-5, -1e-5)
        )
        asked = -np.asarray(slopes)[:, k].reshape(here.shape)
        np.testing.assert_allclose(asked, (ahead - behind) / 2e-5, atol=1e-3 * np.abs(asked).max())


@pytest.mark.parametrize("effects", [(0, 2), (2, 3), (3, 2), (5, 2), (2, 5)])
def test_effects_beside_others_have_the_slopes_of_differences(problem, effects):
    """Commands pass one effect after the other, and friction holds against what they then exert."""
    pairs = [*problem.pairs, (EFFECTS["back_emf"], "actuator/motor")]
    has_the_slopes_of_differences(problem.screen(pairs).scene, Candidate(effects))


@pytest.mark.parametrize("effects", [(0, 2), (1, 2), (0, 1, 2), (1, 3)])
def test_what_arrived_of_commands_before_a_window_has_the_slopes_of_differences(problem, effects):
    """A rotor on a spring and a motor in its gap remember what moved them, which another effect has changed."""
    act, joint = "actuator/motor", "joint/hinge"
    named = (("actuator_lag", act), ("back_emf", act), ("joint_flexibility", joint), ("backlash", act))
    steps = np.arange(-problem.motion.past.shape[1], 0)[:, None] * problem.system.dt
    first = [np.asarray(x)[:, :1] for x in (problem.motion.qpos, problem.motion.qvel)]
    earlier = first[0] + first[1] * steps, first[1] + 0.0 * steps
    motion = dataclasses.replace(problem.motion, earlier=tuple(map(jnp.asarray, earlier)))
    screen = dataclasses.replace(problem, motion=motion).screen([(EFFECTS[name], place) for name, place in named])
    has_the_slopes_of_differences(screen.scene, Candidate(effects))


def test_a_pair_on_one_motor_is_found_in_the_order_of_the_machine(problem, tmp_path):
    """A bias that is added to a limited command is not one that is limited with it."""
    names = ("actuator_bias", "actuator_saturation")
    make_case(tmp_path / "rig", "pendulum", names[::-1], strength=0.3, seed=2, recordings=2, seconds=2.0)
    rig = pose(tmp_path / "rig", [(name, "actuator/motor") for name in names])
    screen = rig.screen(rig.pairs)
    nothing = screen.begin(jnp.zeros(screen.d), jnp.array([0.01, 0.1]))
    begun = screen.begin_candidate(Candidate((0, 1)), nothing)
    pair = screen.finish_candidate(screen.resume_candidate(begun, nothing), nothing)
    turned = _turn(screen, pair)
    assert turned.candidate.effects == (1, 0) and turned.score > pair.score + 100
    assert _turn(screen, turned) is turned


def predicted(bench, candidate, x):
    shots = bench.setup(candidate)
    still = jnp.zeros((shots.y.shape[0], shots.spread.size))
    return predict_all(bench.simulator(candidate), shots, x[: bench.used(candidate)], still)


def test_no_candidate_is_the_simulator_as_it_is(problem):
    bench = problem.bench(problem.pairs)
    x = bench.starts(Candidate(), jnp.array([0.3]))[0]
    theta = problem.margins.theta(jnp.array([0.3]))
    plain = jax.vmap(lambda w: replay_window(problem.system, theta, jnp.zeros(2), w))(problem.shots.inputs)
    np.testing.assert_allclose(predicted(bench, Candidate(), x), plain, atol=1e-10)


@pytest.mark.parametrize("excused", [True, False])
def test_what_an_effect_remembers_unseen_excuses_no_more_than_is_missed(problem, excused):
    """A free force in every window explains pieces of any slow push; of the time ahead it has to say something."""
    bench = problem.bench([(EFFECTS["hysteresis"], "joint/hinge")])
    bent, plain = Candidate((0,)), Candidate()
    x, theta = bench.starts(bent, jnp.array([0.3]))[-1], bench.starts(plain, jnp.array([0.3]))[0]
    here, base = bench.replay(bent, x, problem.shots), bench.replay(plain, theta, problem.shots)
    fit = SimpleNamespace(z=x, usual_move=np.array([0.0, 0.0, 1e3 if excused else 1e-9]))
    misfit = SimpleNamespace(noise=np.full(here.shape[-1], 1e-4))
    entry = SimpleNamespace(candidate=bent, fit=fit, misfit=misfit, ahead=np.nan)
    _foresee(bench, SimpleNamespace(candidate=plain, fit=SimpleNamespace(z=theta)), [entry], problem.shots)
    assert entry.ahead == pytest.approx(error_left(problem.shots, here, base, misfit.noise), rel=1e-3)


def test_a_candidate_has_its_own_parameters_in_physical_units(problem):
    bench = problem.bench(problem.pairs)
    stribeck = Candidate((1,))
    assert bench.columns(stribeck) == [1, 2, 3]
    x = bench.starts(stribeck, jnp.array([0.0]))[-1]
    values = bench.values(stribeck, x)
    own = EFFECTS["stribeck_friction"].parameters("joint/hinge", problem.scales["joint/hinge"])
    assert [key.rpartition("/")[2] for key in values] == [p.name for p in own]
    np.testing.assert_allclose(list(values.values()), [p.start for p in own], rtol=1e-6)
    both = stribeck + Candidate((0,))
    assert both.effects == (0, 1) and [bench.name(k) for k in both.effects] == [
        "coulomb_friction@joint/hinge",
        "stribeck_friction@joint/hinge",
    ]
    assert bool((bench.free(stribeck) == (jnp.arange(bench.size) < 4)).all())


def test_the_concealed_effect_lowers_the_cost_most(problem):
    bench = problem.bench(problem.pairs)
    sigma = jnp.array([0.02, 0.2])
    costs = []
    for k in range(len(problem.pairs)):
        fits = [
            bench.fit(Candidate((k,)), x, jnp.zeros((len(problem.group), 2)), sigma)
            for x in bench.starts(Candidate((k,)), jnp.array([0.0]))
        ]
        costs.append(min(float(fit.cost) for fit in fits))
    assert int(np.argmin(costs)) in (0, 1)
    assert costs[0] < 0.2 * min(costs[2:])


def test_the_concealed_effect_comes_out_first_along_the_motion(problem):
    screen = problem.screen(problem.pairs)
    nothing = screen.begin(jnp.array([0.0]), jnp.array([0.02, 0.2]))
    begun = [screen.begin_candidate(Candidate((k,)), nothing) for k in range(len(problem.pairs))]
    found = [screen.finish_candidate(item, nothing) for item in begun]
    assert int(np.argmax([item.likelihood for item in begun])) in (0, 1)
    scores = [item.score - nothing.score for item in found]
    assert int(np.argmax(scores)) in (0, 1)
    assert max(scores[2:]) < 0.5 * scores[0]
    level = screen.scene.margin[0][0].value(found[0].p[screen.d])
    bench = problem.bench(problem.pairs)
    fit = bench.fit(Candidate((0,)), found[0].p, jnp.zeros((len(problem.group), 2)), found[0].sigma)
    simulated = bench.values(Candidate((0,)), fit.z)["coulomb_friction@joint/hinge/coulomb"]
    assert float(level) == pytest.approx(simulated, rel=0.05)


def test_fits_begin_all_over_parameters_with_many_maxima(problem):
    names = ("torque_ripple", "disturbance_event", "viscous_friction")
    screen = problem.screen([(EFFECTS[name], "joint/hinge") for name in names])
    ripple, event, viscous = (np.array(screen.starts(Candidate((k,)))) for k in range(len(names)))
    parameters = {p.name: k for k, p in enumerate(screen.scene.parameters[0])}
    assert len(np.unique(ripple[:, parameters["cycles"]].round(9))) >= 20
    begin, end = (screen.scene.margin[1][k].value(event[:10, k]) for k in (0, 1))
    assert (begin < end).all() and np.ptp(begin) > 0.6 * problem.scales["joint/hinge"].duration
    # whichever way the push went, a scan of its time begins from none
    np.testing.assert_allclose(screen.scene.margin[1][2].value(event[2:10, 2]), 0.0, atol=1e-9)
    assert viscous.shape == (3, 1)


@pytest.mark.parametrize("group", [[0] * 9, [0, 0, 0, 1, 1, 2, 2, 3, 4]])
def test_every_window_is_scored_by_a_fit_to_others(group):
    group = np.array(group)
    folds = np.array(_folds(group))
    assert (folds.sum(0) == 1).all()
    assert (folds.sum(1) < len(group)).all()
    if len(set(group)) > 1:
        assert all((fold[group == label] == fold[group == label][0]).all() for fold in folds for label in set(group))


def test_scores_are_those_of_fits_without_the_fold(problem):
    """Linear around one fit to all windows, beside fits to the others, from whose θ each window's state is fitted."""
    bench, exact = problem.bench(()), np.zeros(len(problem.group))
    z, still = jnp.zeros(bench.size), jnp.zeros((len(problem.group), 2))
    baseline = bench.fit(Candidate(), z, still, jnp.array([0.02, 0.2]))
    entry = detect(jax.random.key(0), problem, baseline.replace(z=baseline.z[:1]))[1]
    for out in np.array(_folds(problem.group)):
        kept = dataclasses.replace(problem.shots, measured=problem.shots.measured & ~out[:, None, None])
        left = dataclasses.replace(problem.shots, measured=problem.shots.measured & out[:, None, None])
        bench.shots = kept
        fit = bench.fit(Candidate(), entry.fit.z, entry.fit.delta, entry.fit.sigma, steps=30)
        sigma = estimate_noise(kept, fit, 0.0 * fit.sigma)
        shots = dataclasses.replace(bench.setup(Candidate()), measured=left.measured)
        held = jnp.zeros(bench.size, bool)
        judged = solve(bench.simulator(Candidate()), shots, fit.z, entry.fit.delta, sigma, held, live=bench.d)
        logs = -0.5 * judged.r**2 - jnp.log(sigma)
        exact += np.where(out, np.where(left.measured, logs, 0.0).sum((1, 2)), 0.0)
    np.testing.assert_allclose(entry.scores, exact, rtol=0.02)


def test_a_special_case_begins_with_the_numbers_of_what_contains_it(problem):
    """So that both predict the same there: a Stribeck curve whose levels are equal is a dry friction."""
    bench = problem.bench(problem.pairs)
    general, special = Candidate((1, 4)), Candidate((0, 4))
    coulomb, static, velocity = bench.columns(Candidate((1,)))
    level = 0.3 * bench.parameters[coulomb].high
    z = np.zeros(bench.size)
    z[: bench.d] = 0.4
    for j, (column, value) in enumerate(((coulomb, level), (static, level), (velocity, 0.1))):
        z[bench.d + j] = bench.each[column].standard(jnp.asarray(value))
    z[bench.d + 3] = -0.7  # the armature, which both have
    known = SimpleNamespace(candidate=general, fit=SimpleNamespace(z=jnp.asarray(z)))
    begun = _with_numbers_of(bench, known, special, jnp.zeros(bench.size))
    assert bench.values(special, begun)["coulomb_friction@joint/hinge/coulomb"] == pytest.approx(level)
    same = [bench.replay(candidate, x, bench.shots) for candidate, x in ((general, z), (special, begun))]
    np.testing.assert_allclose(*same, atol=1e-12)


@pytest.mark.parametrize(("seconds", "told"), [(0.0015, [0]), (0.0025, [0, 2])])
def test_a_delay_shorter_than_a_step_is_not_told(problem, seconds, told):
    scales = {place: dataclasses.replace(own, shift=0.002) for place, own in problem.scales.items()}
    bench = dataclasses.replace(problem, scales=scales).bench(problem.pairs)
    both = Candidate((0, 2))
    level, delay = (bench.each[i].standard(v) for i, v in zip(bench.columns(both), (1e-6, seconds), strict=True))
    x = jnp.zeros(bench.size).at[bench.d].set(level).at[bench.d + 1].set(delay)
    assert bench.told(both, x) == told
    assert bench.largest_shift == 0.002
    assert problem.bench(problem.pairs).told(both, x) == [0, 2], "a simulator whose step moves nothing"


def test_a_rotor_trades_for_a_gap_and_nothing_else_changes(problem):
    """As long through a gap of half the size with twice the rotor; no other effect of the pair has other numbers."""
    pairs = [problem.pairs[2], (EFFECTS["backlash"], "actuator/motor")]
    bench = problem.bench(pairs)
    both = Candidate((0, 1))
    x = np.array(bench.starts(both, jnp.array([0.3]))[-1])
    here = bench.values(both, x)
    gap, rotor = (f"backlash@actuator/motor/{name}" for name in ("gap", "rotor_inertia"))
    points = bench.traded(both, x)
    assert len(points) == 2 and not bench.traded(Candidate((0,)), x)
    for point, by in zip(points, (2.0, 0.5), strict=True):
        there = bench.values(both, point)
        assert there[gap] == pytest.approx(by * here[gap]) and there[rotor] == pytest.approx(here[rotor] / by)
        assert all(there[name] == pytest.approx(here[name]) for name in here if name not in (gap, rotor))
        np.testing.assert_array_equal(point[: bench.d + 1], x[: bench.d + 1])


def test_stand_ins_take_the_place_of_effects_of_a_set(problem):
    bench = problem.bench(problem.pairs)
    assert _stand_ins(bench, Candidate((1, 2))) == [Candidate((0, 2))]
    assert _stand_ins(bench, Candidate((0, 2))) == []
    assert _stand_ins(bench, Candidate((0, 1))) == [], "it is in the set already"
    assert _stand_ins(bench, Candidate((1,))) == [Candidate((0,))]
    assert _stand_ins(bench, Candidate((0,))) == []
    twins = (("viscous_friction", "joint/hinge"), ("back_emf", "actuator/motor"), ("armature", "joint/hinge"))
    bench = problem.bench([(EFFECTS[name], place) for name, place in twins])
    assert _stand_ins(bench, Candidate((0, 2))) == [Candidate((1, 2))]
    assert _stand_ins(bench, Candidate((1, 2))) == [Candidate((0, 2))]
    places = {"sensor_offset": "joint/hinge/qpos", "base_tilt": "world#joint/hinge", "link_offset": "body/rod#across"}
    zeros = [*places.items(), ("link_offset", "body/rod"), ("armature", "joint/hinge")]
    problem = dataclasses.replace(problem, scales={place: Scales(timestep=0.002, period=0.004) for _, place in zeros})
    bench = problem.bench([(EFFECTS[name], place) for name, place in zeros])
    for one, others in ((0, (1, 2)), (1, (0, 2)), (2, (0, 1))):
        assert _stand_ins(bench, Candidate((one, 4))) == [Candidate((other, 4)) for other in others]
    assert _stand_ins(bench, Candidate((3, 4))) == [], "along the link it is a length"


def test_siblings_take_the_place_of_a_law_if_they_are_asked_for(problem):
    """Laws that have a special case in common; what is no more than that special case has none."""
    names = ("coulomb_friction", "stribeck_friction", "load_dependent_friction", "armature")
    bench = problem.bench([(EFFECTS[name], "joint/hinge") for name in names])
    simpler, sibling = Candidate((0, 3)), Candidate((2, 3))
    assert _stand_ins(bench, Candidate((1, 3))) == [simpler]
    assert _stand_ins(bench, Candidate((1, 3)), siblings=True) == [simpler, sibling]
    assert _stand_ins(bench, simpler, siblings=True) == []


def test_pairs_that_are_simulated_differ_in_their_effects():
    """The best four, and two of those that come near and have an effect that none of these has."""

    def found(score, *effects):
        return SimpleNamespace(candidate=Candidate(effects), score=score)

    best = [found(100.0, 0, 1), found(99.0, 1, 2), found(98.0, 0, 2), found(97.0, 2, 3)]
    others = [found(96.0, 0, 3), found(95.0, 1, 4), found(94.0, 2, 4), found(93.0, 3, 4), found(10.0, 0, 5)]
    assert varied([*best, *others], 0.0) == [*best, *others[1:3]]
    assert varied([*best, *others], 79.0) == [*best, others[1]]
    assert varied(best[:2], 0.0) == best[:2]


@pytest.mark.parametrize(("z", "low", "share"), [(0.0, -1.0, 0.0), (1.0, -1.0, -5.105), (0.3, 0.01, -4.65)])
def test_a_term_that_is_absent_is_no_coincidence(z, low, share):
    """A number at 0, one that is not, and one whose range ends near 0: precision 10⁴, so that ½ log 10⁴ = 4.605."""
    parameter = EffectParameter("cubic", "", low, 1.0, 0.0, 0.5)
    bench = SimpleNamespace(
        d=0, parameters=[parameter], each=[margin_of_effect(parameter)], columns=lambda candidate: [0]
    )
    fit = SimpleNamespace(z=np.array([z]), precision=np.array([[1e4]]))
    assert _log_share(bench, Candidate((0,)), fit) == pytest.approx(share, abs=1e-3)


@pytest.mark.parametrize(("factor", "share"), [(1.0, 0.0), (1.05, -4.605)])
def test_a_factor_of_one_is_no_coincidence(factor, share):
    """A motor of the resistance that it was believed to have, and of another one."""
    parameter = EffectParameter("resistance", "", 0.2, 5.0, 1.0, 1.05, log=True)
    margin = margin_of_effect(parameter)
    bench = SimpleNamespace(d=0, parameters=[parameter], each=[margin], columns=lambda candidate: [0])
    fit = SimpleNamespace(z=np.array([float(margin.standard(factor))]), precision=np.array([[1e4]]))
    assert _log_share(bench, Candidate((0,)), fit) == pytest.approx(share, abs=0.02)
