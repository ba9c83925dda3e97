"""Members are what their laws say, the same for the same key, and fly as single loops do."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import ArrayLike
from scipy import stats

import jaxquad as jq
from jaxquad.control import ScheduledLADRC
from jaxquad.ensembles import (
    Choice,
    Ensemble,
    Fixed,
    LogNormal,
    LogUniform,
    Normal,
    Payload,
    Uniform,
)


KEY, OTHER = jax.random.key(0), jax.random.key(1)
AXIS = jq.DecoupledAxes([0.0468], [0.0552])
AXES = jq.DecoupledAxes([0.0468], [0.0552, 0.06, 0.11], damping=0.01)
COUNT, DT, SAMPLES = 8, 0.002, 250
SCENARIO = jq.scenario(duration=SAMPLES * DT, axes=1, reference=jq.Step(np.radians(4.0)))


class Around(NamedTuple):
    """An ensemble around the nominal loop of a plant."""

    loop: jq.Loop
    ensemble: Ensemble

    def draw(self, n, key) -> Any:  # the plants are of any kind that an ensemble varies
        return self.ensemble.draw(self.loop, n, key)

    def fresh(self, n, key) -> Any:
        return self.ensemble.fresh(self.loop, n, key)


def drive_of(vehicle):
    if vehicle.allocation.input == "voltage":
        return jq.simulation.MotorDrive(vehicle.allocation)
    sheet = jq.models.CRAZYFLIE
    return jq.simulation.RotorDrive(vehicle.allocation, sheet.hover_input, sheet.top_speed)


def made(plant, drive=None, nominal_delay: ArrayLike = 0.0, **laws) -> Around:
    drive = drive_of(plant) if isinstance(plant, jq.models.Multirotor) else drive
    controller = jq.LADRC(10.0, 30.0, 0.848)
    loop = jq.Loop(plant, controller, drive=drive, dt=DT, delay=nominal_delay)
    return Around(loop, Ensemble(**laws))


def study(plant=AXIS, *, drive=None, **changes) -> Around:
    """The ensemble of docs/tuning.md."""
    laws = {
        "inertia": LogUniform(0.5, 3.0), "torque_gain": Normal(0.05),
        "assumed_inertia": Normal(0.1), "lag": Uniform(0.01, 0.04), "coulomb": 0.002,
        "noise": np.radians(0.02), "gust_corner": 200.0,
    }  # fmt: skip
    return made(plant, drive or jq.simulation.Saturation(10.0), 0.004, **(laws | changes))


@pytest.fixture(scope="module")
def many():
    return study(sampling="random").draw(4096, KEY)


def test_each_quantity_follows_its_law(many):
    """Kolmogorov-Smirnov against scipy's distributions; 4 sd leave 6e-5 out."""
    drawn = {
        "inertia": (many.plant.inertia / 0.0552, stats.loguniform(0.5, 3.0)),
        "gain": (many.plant.torque_gain / 0.0468, stats.truncnorm(-4, 4, 1, 0.05)),
        "lag": (many.plant.lag, stats.uniform(0.01, 0.03)),
        "assumed_inertia": (
            many.assumed_inertia / many.plant.inertia,
            stats.truncnorm(-4, 4, 1, 0.1),
        ),
    }
    for values, law in drawn.values():
        assert stats.kstest(np.asarray(values[0]), law.cdf).pvalue > 1e-3
    table = np.corrcoef(np.stack([np.asarray(values[0]) for values, _ in drawn.values()]))
    # 4096 draws know a correlation of 0 to 0.016.
    assert np.max(np.abs(table - np.eye(4))) < 0.06
    assert np.all(np.asarray(many.delay) == 0.004) and many.longest_delay == 0.004


@pytest.mark.parametrize(
    "law, peer",
    [
        (Uniform(-1.0, 2.0), stats.uniform(-1, 3)),
        (LogUniform(0.2, 5.0), stats.loguniform(0.2, 5)),
        (Normal(0.3, mean=2.0), stats.truncnorm(-4, 4, 2, 0.3)),
        (LogNormal(0.5, 3.0), stats.lognorm(0.5, scale=3.0)),
        (Choice([3.0, 1.0, 2.0]), None),
        (Fixed(0.7), None),
    ],
    ids=lambda x: type(x).__name__,
)
def test_quantiles_are_scipys_and_stay_in_the_support(law, peer):
    u = np.linspace(0, 1, 101)[None]
    values, (low, high) = np.asarray(law.quantile(u))[0], law.support
    assert np.all((values > low - 1e-12) & (values < high + 1e-12))
    if peer is not None:
        # What lies beyond 4 sd, 6e-5 of the probability, is the difference of the log-normal.
        inner = slice(5, -5)
        np.testing.assert_allclose(values[inner], peer.ppf(u[0])[inner], rtol=2e-4)
        assert np.all(np.diff(values) > 0)


def test_choices_are_equally_likely():
    values = np.asarray(Choice([3.0, 1.0, 2.0]).quantile((np.arange(12)[None] + 0.5) / 12))
    np.testing.assert_array_equal(values[0], np.repeat([3.0, 1.0, 2.0], 4))


def test_a_latin_hypercube_has_one_member_in_each_share_of_each_law():
    members = study().draw(COUNT, KEY)
    shares = [
        np.log(np.asarray(members.plant.inertia[0]) / 0.0552 / 0.5) / np.log(6.0),
        (np.asarray(members.plant.lag[0]) - 0.01) / 0.03,
        stats.truncnorm(-4, 4, 1, 0.05).cdf(np.asarray(members.plant.torque_gain[0]) / 0.0468),
    ]
    for share in shares:
        assert sorted(np.floor(COUNT * share).astype(int)) == list(range(COUNT))


def test_sobol_points_are_more_even_than_random_ones():
    law = {"inertia": Uniform(0.5, 1.5), "lag": Uniform(0.0 + 1e-9, 1.0), "torque_gain": 1.0}

    def discrepancy(sampling):
        members = study(sampling=sampling, assumed_inertia=1.0, **law).draw(100, KEY)
        points = [members.plant.inertia[0] / 0.0552 - 0.5, members.plant.lag[0]]
        return stats.qmc.discrepancy(np.clip(np.stack(points, axis=1), 0, 1))

    assert discrepancy("sobol") < 0.3 * discrepancy("random")


def test_a_grid_holds_the_ends_and_every_combination():
    inertia = made(AXIS, inertia=LogUniform(0.5, 3.0), sampling="grid").draw(COUNT, KEY)
    expected = 0.0552 * np.geomspace(0.5, 3.0, COUNT)
    np.testing.assert_allclose(inertia.plant.inertia[0], expected, rtol=1e-12)
    two = {"inertia": LogUniform(0.5, 3.0), "lag": Uniform(0.01, 0.04), "sampling": "grid"}
    both = made(AXIS, **two).draw(9, KEY)
    pairs = {(round(float(a), 9), round(float(b), 9))
             for a, b in zip(both.plant.inertia[0], both.plant.lag[0], strict=True)}  # fmt: skip
    assert len(pairs) == 9 and len({a for a, _ in pairs}) == 3
    with pytest.raises(ValueError, match="draw 9 or 16"):
        made(AXIS, **two).draw(10, KEY)


def arrays(members):
    """All but the keys."""
    floats = eqx.filter(
        members, lambda x: eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating)
    )
    return [np.asarray(x) for x in jax.tree.leaves(floats)]


def test_the_key_alone_decides_and_fresh_members_are_others():
    ensemble = study()
    one, again, other = (ensemble.draw(COUNT, key) for key in (KEY, KEY, OTHER))
    fresh = ensemble.fresh(COUNT, KEY)
    assert all(map(np.array_equal, arrays(one), arrays(again)))
    for drawn in (other, fresh, study(sampling="grid", assumed_inertia=1.0).fresh(COUNT, KEY)):
        assert not np.intersect1d(drawn.plant.inertia, one.plant.inertia).size
        assert not np.array_equal(drawn.flight(SCENARIO).noise, one.flight(SCENARIO).noise)


def test_fresh_members_do_not_follow_those_that_were_tuned_on():
    """1024 pairs know a correlation of 0 to 0.03; noise samples to 0.02 and less."""
    ensemble = study()
    one, fresh = ensemble.draw(1024, KEY), ensemble.fresh(1024, KEY)
    pairs = [(one.plant.inertia[0], fresh.plant.inertia[0]), (one.plant.lag[0], fresh.plant.lag[0])]
    short = [m.take(np.arange(COUNT)).flight(SCENARIO).noise for m in (one, fresh)]
    pairs.append((short[0].ravel(), short[1].ravel()))
    assert all(abs(np.corrcoef(np.stack(pair))[0, 1]) < 0.1 for pair in pairs)


def test_draws_of_a_number_have_one_shape_and_compile_once():
    ensemble, traces = study(delay=Uniform(0.001, 0.006)), []

    @eqx.filter_jit
    def fly(members):
        traces.append(1)
        return members.flight(SCENARIO).noise.sum() + members.plant.gain.sum()

    for members in (
        ensemble.draw(COUNT, KEY),
        ensemble.draw(COUNT, OTHER),
        ensemble.fresh(COUNT, KEY),
    ):
        fly(members)
    assert len(traces) == 1


def test_members_are_drawn_outside_jit():
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda key: study().draw(COUNT, key).delay)(KEY)


@pytest.mark.slow
def test_both_precisions_draw_the_same_members_and_noise():
    double = study(gust=0.01).draw(COUNT, KEY)
    with jax.enable_x64(False):
        plant = jq.DecoupledAxes([0.0468], [0.0552])
        single = study(plant, gust=0.01).draw(COUNT, KEY)
        happens = jq.scenario(duration=SAMPLES * DT, axes=1)
        noise = single.flight(happens).noise
    assert {x.dtype for x in arrays(single)} == {np.dtype("float32")} and noise.dtype == np.float32
    for one, other in zip(arrays(single), arrays(double), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
    np.testing.assert_allclose(noise, double.flight(SCENARIO).noise, rtol=1e-5, atol=1e-9)


@pytest.mark.slow
def test_each_member_keeps_its_own_noise_gust_and_payload_when_others_are_left_out():
    payload = Payload(Uniform(0.2, 1.0), at=Uniform(0.1, 0.2), width=Uniform(0.05, 0.1))
    members = study(gust=Uniform(0.01, 0.03), payload=payload).draw(COUNT, KEY)
    chosen = np.array([3, 6])
    whole, part = members.flight(SCENARIO), members.take(chosen).flight(SCENARIO)
    assert members.take(chosen).size == 2 and members.size == COUNT
    for name in ("noise", "disturbance", "payload"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[..., chosen])
    assert np.asarray(part.reference).ndim == 2  # what is the same for all stays narrow


def test_noise_and_gusts_have_the_deviation_of_each_member():
    laws = {"noise": Choice([1e-4, 5e-4]), "gust": Choice([0.01, 0.03]), "sampling": "random"}
    members = study(**laws).draw(COUNT, KEY)
    flight = members.flight(SCENARIO)
    noise, gust = (np.asarray(x)[:, 0] for x in (flight.noise, flight.disturbance))
    assert len(set(np.asarray(members.noise[0]))) == len(set(np.asarray(members.gust[0]))) == 2
    # 250 samples know a deviation to 4.5 %; gusts are correlated over 2.5 samples.
    np.testing.assert_allclose(np.std(noise, axis=0), members.noise[0], rtol=0.15)
    np.testing.assert_allclose(np.std(gust, axis=0), members.gust[0], rtol=0.25)
    units = gust / np.asarray(members.gust)
    correlation = np.mean(units[1:] * units[:-1]) / np.mean(units**2)
    assert correlation == pytest.approx(np.exp(-200.0 * DT), abs=0.08)
    both = np.corrcoef(np.concatenate([noise.T, gust.T]))
    assert np.max(np.abs(both - np.eye(2 * COUNT))) < 0.35


def test_what_a_scenario_already_holds_is_kept():
    wide = jq.scenario(
        duration=SAMPLES * DT,
        axes=1,
        noise=jq.simulation.WhiteNoise(1e-3),
        ensemble=COUNT,
        key=OTHER,
    )
    members = study(gust=0.01).draw(COUNT, KEY)
    own = members.flight(SCENARIO)
    both = members.flight(wide)
    np.testing.assert_allclose(both.noise, np.asarray(wide.noise) + own.noise, rtol=1e-12)
    np.testing.assert_array_equal(both.disturbance, own.disturbance)
    assert both.payload is None and both.ensemble == (COUNT,)


LADRC = ScheduledLADRC(
    jq.LADRC(4.0, 50.0, 1.0, limit=10.0),
    jq.control.certainty_equivalence(0.0468, 0.0552, factor=1.8),
)


def flown(members, happens):
    return np.asarray(jq.simulate(members.loop(LADRC), happens).angle)


@pytest.mark.slow
def test_a_member_flies_as_the_plant_that_it_stands_for():
    members, k = study().draw(COUNT, KEY), 5
    happens, plant = members.flight(SCENARIO), members.plant
    lone = jq.DecoupledAxes(
        plant.torque_gain[:, k], plant.inertia[:, k], lag=plant.lag[:, k], coulomb=0.002
    )
    happening = eqx.tree_at(lambda s: s.noise, happens, happens.noise[..., k])
    told = LADRC.scheduled_at(members.assumed_inertia[:, k])
    alone = jq.simulate(
        jq.Loop(lone, told, delay=0.004, drive=jq.simulation.Saturation(10.0)), happening
    ).angle
    np.testing.assert_allclose(flown(members, happens)[..., k], alone, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_a_payload_from_the_start_is_more_inertia():
    heavy = study(payload=Payload(0.5, at=0.0), inertia=Uniform(0.5, 1.0)).draw(COUNT, KEY)
    inertia = heavy.plant.inertia + 0.5 * 0.0552
    more = eqx.tree_at(lambda m: (m.plant.inertia, m.payload), heavy, (inertia, None))
    angles = [flown(members, members.flight(SCENARIO)) for members in (heavy, more)]
    np.testing.assert_allclose(*angles, rtol=1e-9, atol=1e-15)


def test_a_payload_is_carried_from_its_time_for_its_width():
    members = study(payload=Payload(Uniform(0.5, 1.0), at=Uniform(0.1, 0.2), width=0.1)).draw(
        8, KEY
    )
    payload = np.asarray(members.flight(SCENARIO).payload)[:, 0]
    assert members.payload is not None
    for k in range(COUNT):
        carried = np.flatnonzero(payload[:, k])
        assert abs(carried[0] * DT - float(members.payload.at[k])) <= DT / 2 + 1e-9
        assert abs(carried.size - 50) <= 1
        np.testing.assert_allclose(payload[carried, k], members.payload.inertia[0, k])


@pytest.mark.parametrize("plant", [jq.quanser_hover(), jq.crazyflie()], ids=["hover", "crazyflie"])
def test_a_multirotor_varies_as_its_decoupled_axes_do(plant):
    laws = {"inertia": LogUniform(0.5, 3.0), "torque_gain": Normal(0.05), "lag": Normal(0.1),
            "stiffness": Uniform(0.0, 0.1), "damping": [0.01, 0.01, 0.02]}  # fmt: skip
    members = made(plant, **laws).draw(COUNT, KEY)
    axes = made(plant.decoupled(), **laws).draw(COUNT, KEY)
    apart = members.plant.decoupled()
    for name in ("torque_gain", "inertia", "lag", "stiffness", "damping"):
        ours, theirs = (np.asarray(getattr(p, name)) for p in (apart, axes.plant))
        np.testing.assert_allclose(*np.broadcast_arrays(ours, theirs), rtol=1e-12)
    np.testing.assert_allclose(members.assumed_inertia, members.plant.attitude.inertia, rtol=1e-12)
    part = members.take([6]).plant
    np.testing.assert_array_equal(part.attitude.inertia, members.plant.attitude.inertia[:, 6:7])
    np.testing.assert_array_equal(part.motor.time_constant, members.plant.motor.time_constant[6:7])
    assert part.attitude.damping.shape == (3,) and part.allocation.arm.shape == (1,)


def test_members_of_a_hover_fit_its_loop():
    plant = jq.quanser_hover()
    drive = jq.simulation.MotorDrive(plant.allocation)
    laws = {"inertia": LogUniform(0.5, 3.0), "torque_gain": Normal(0.05), "noise": 1e-4}
    members = made(plant, **laws, delay=0.004).draw(COUNT, KEY)
    ladrc = jq.LADRC(4.0, 50.0, [0.9, 0.9, 0.15], limit=10.0)
    happens = members.flight(jq.scenario(duration=SAMPLES * DT))
    run = lambda: jq.simulate(
        jq.Loop(members.plant, ladrc, delay=members.delay, drive=drive), happens
    )
    assert jax.eval_shape(lambda: run().angle).shape == (SAMPLES, 3, COUNT)


def test_axes_share_what_is_drawn_unless_they_are_independent():
    together = made(AXES, inertia=LogUniform(0.5, 3.0)).draw(COUNT, KEY)
    factors = np.asarray(together.plant.inertia) / np.array([[0.0552], [0.06], [0.11]])
    np.testing.assert_allclose(factors, np.broadcast_to(factors[:1], factors.shape), rtol=1e-12)
    alone = made(AXES, inertia=LogUniform(0.5, 3.0), independent=("inertia",)).draw(COUNT, KEY)
    factors = np.asarray(alone.plant.inertia) / np.array([[0.0552], [0.06], [0.11]])
    shares = np.floor(COUNT * np.log(factors / 0.5) / np.log(6.0)).astype(int)
    assert all(sorted(row) == list(range(COUNT)) for row in shares)
    assert len({tuple(row) for row in shares}) == 3


def test_a_law_may_have_a_number_for_each_axis():
    law = Uniform([0.01, 0.02, 0.03], [0.02, 0.03, 0.05])
    lag = np.asarray(made(AXES, lag=law, damping=Normal(0.1)).draw(COUNT, KEY).plant.lag)
    assert np.all((lag > law.support[0][:, None]) & (lag < law.support[1][:, None]))


def test_what_does_not_vary_is_that_of_the_loop():
    nominal = made(AXIS, jq.simulation.Saturation(3.0), 0.004)
    members = nominal.draw(COUNT, KEY)
    assert np.all(np.asarray(members.delay) == 0.004) and members.longest_delay == 0.004
    assert members.drive is nominal.loop.drive and members.dt == DT
    for name in ("torque_gain", "inertia"):
        drawn = np.broadcast_to(vars(members.plant)[name], (1, COUNT))
        np.testing.assert_array_equal(drawn, np.broadcast_to(vars(AXIS)[name][:, None], (1, COUNT)))
    late = made(AXIS, nominal_delay=0.004, delay=Normal(0.1)).draw(COUNT, KEY).delay
    assert np.mean(late) == pytest.approx(0.004, rel=0.05) and np.std(late) > 1e-4


def test_str_is_a_table_of_what_varies_and_how():
    text = str(study(payload=Payload(Uniform(0.0, 1.0), at=2.0)).ensemble)
    lines = {line.split()[0]: line for line in text.splitlines()[1:]}
    assert "log-uniform 0.5 .. 3" in lines["inertia"] and "nominal" in lines["inertia"]
    assert "uniform 0.01 .. 0.04" in lines["lag"] and lines["lag"].endswith(" s")
    assert "normal 1 +- 0.1" in lines["assumed_inertia"] and "latin" in text
    assert len(text.splitlines()) < 15


WRONG = {
    "inertia=Uniform(-0.1, 3)": (dict(inertia=Uniform(-0.1, 3.0)), "inertia .* -0.1.* above 0"),
    "inertia=Normal(0.3)": (dict(inertia=Normal(0.3)), "inertia .*LogNormal"),
    "inertia=0": (dict(inertia=0.0), "above 0"),
    "assumed_inertia=Normal(0.25)": (dict(assumed_inertia=Normal(0.25)), "assumed_inertia"),
    "lag=0": (dict(lag=0.0), "leave it None"),
    "lag=Normal(0.1)": (dict(lag=Normal(0.1)), "give the mean"),
    "delay<0": (dict(delay=Uniform(-0.001, 0.004)), "cannot be negative"),
    "noise<0": (dict(noise=-1e-4), "standard deviation"),
    "axes": (dict(lag=Uniform([0.01, 0.02], [0.03, 0.04])), "2 axes, but the plant has 1"),
    "delay axes": (dict(delay=[0.01, 0.02]), "the same for all axes"),
    "sampling": (dict(sampling="halton"), "latin, random, sobol, grid"),
    "independent": (dict(independent=("delay",)), "name quantities that vary"),
    "lost": (dict(payload=Payload(-0.5, at=1.0)), "remove less inertia"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_cannot_be_is_refused(what):
    laws, message = WRONG[what]
    with pytest.raises(ValueError, match=message):
        study(**laws).draw(COUNT, KEY)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Uniform(2.0, 1.0), "low < high"),
        (lambda: Uniform(1.0, 1.0), "plain number"),
        (lambda: LogUniform(0.0, 1.0), "Uniform"),
        (lambda: LogUniform(np.nan, 1.0), "finite"),
        (lambda: Normal(-0.1), "deviation"),
        (lambda: Normal(0.0), "plain number"),
        (lambda: LogNormal(0.1, -1.0), "median"),
        (lambda: Choice([1.0]), "two or more"),
        (lambda: Uniform(np.array([[1.0]]), np.array([[2.0]])), "one for each axis"),
        (lambda: Uniform([1.0, 2.0], [3.0, 4.0, 5.0]), "one for each axis"),
        (lambda: Fixed(np.inf), "finite"),
    ],
)
def test_empty_laws_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_what_belongs_to_the_loop_is_refused_in_an_ensemble(without_type_checks):
    wrong: Any = AXIS
    with pytest.raises(ValueError, match="plants is a DecoupledAxes.*jq.Loop"):
        Ensemble(wrong)
    with pytest.raises(ValueError, match="loop is a DecoupledAxes"):
        Ensemble().draw(wrong, COUNT, KEY)
    with pytest.raises(ValueError, match="the loop's plant is a LaggedIntegrator.*Posterior"):
        model: Any = jq.LaggedIntegrator(1.0)
        made(wrong).ensemble.draw(jq.Loop(model, jq.LADRC(1, 3, 1)), COUNT, KEY)


def test_plants_that_are_no_single_plant_are_refused():
    with pytest.raises(ValueError, match="already is an ensemble"):
        made(jq.DecoupledAxes([0.05], [[0.05, 0.06]])).draw(COUNT, KEY)
    with pytest.raises(ValueError, match="already is an ensemble"):
        made(AXIS, nominal_delay=np.array([0.0, 0.002])).draw(COUNT, KEY)
    rotors = made(jq.quanser_hover(), torque_gain=Normal(0.05), independent=("torque_gain",))
    with pytest.raises(ValueError, match="the same for all axes"):
        rotors.draw(COUNT, KEY)


def test_requests_that_cannot_be_met_are_refused():
    ensemble = study(payload=Payload(0.5, at=Uniform(0.4, 0.6)))
    members = ensemble.draw(COUNT, KEY)
    for n in (0, -3, True):
        with pytest.raises(ValueError, match="1 or more"):
            ensemble.draw(n, KEY)
    with pytest.raises(ValueError, match="lengthen"):
        members.flight(SCENARIO)
    with pytest.raises(ValueError, match="axes=1"):
        members.flight(jq.scenario(duration=1.0))
    with pytest.raises(ValueError, match="8 members"):
        noise = jq.simulation.WhiteNoise(1.0)
        members.flight(jq.scenario(duration=1.0, axes=1, noise=noise, ensemble=4, key=KEY))
    for wrong in ([8], [-1], [], 3, np.array([0.5])):
        with pytest.raises(ValueError, match="indices"):
            members.take(wrong)
