"""What a certificate says of a design, and on what members."""

import json
from typing import Any

import jax
import ladrc_loop
import numpy as np
import pytest
from certificates_by_hand import missed

import jaxquad as jq
from jaxquad.control import ScheduledLADRC
from jaxquad.ensembles import Ensemble, LogUniform, Payload
from jaxquad.report import write_json
from jaxquad.tuning import certify, CVaR, Limit, Mean, paper_designs, peers, QUANTITIES, upper_bound


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("compiled_quickly")]
RIG = jq.DecoupledAxes([0.0468], [0.0552])
MEMBERS, EVENTS = 24, (0.0, 1.0)
FLIGHT = jq.scenario(
    duration=2.0,
    axes=1,
    reference={0: jq.Step(np.radians(4)) + jq.Step(np.radians(-7), at=1.0)},
    disturbance={0: jq.Pulse(0.05, period=2.0, share=0.1, at=0.5)},
)
OPEN = Ensemble(inertia=LogUniform(0.5, 3.0), noise=np.radians(0.02))
BRIEF = jq.scenario(duration=0.1, axes=1)
FIXED = jq.LADRC(10.0, 30.0, 0.848)
LOOP = jq.Loop(RIG, FIXED, drive=jq.simulation.Saturation(10.0))


def judged(design: Any = FIXED, ensemble: Any = OPEN, flight: Any = FLIGHT, **options: Any):
    given = {"members": MEMBERS, "linear_members": 0, "events": EVENTS, "key": jax.random.key(3)}
    options = given | options
    return certify(LOOP.with_controller(design), ensemble, flight, **options)


@pytest.fixture(scope="module")
def certificate():
    return judged(peers=peers(RIG) | {"twin": FIXED})


def test_members_are_unstable_where_the_eigenvalues_of_an_independent_loop_leave_the_circle(
    certificate,
):
    gains = certificate.facts["torque_gain"][0] / certificate.facts["inertia"][0]
    for name, b0 in (("paper b0 = 3", 3.0), ("paper b0 = 1.6", 1.6)):
        radius = [np.max(np.abs(np.linalg.eigvals(ladrc_loop.loop(gain, b0)[0]))) for gain in gains]
        found = certificate.designs[name]
        np.testing.assert_array_equal(found.unstable, np.array(radius) > 1)
        # Two pairs of poles nearly coincide on some members: a root of the rounding.
        np.testing.assert_allclose(
            found.by_axis["abscissa"][0], np.log(radius) / 0.002, rtol=1e-5, atol=1e-5
        )
    assert 0 < certificate.designs["paper b0 = 3"].unstable_count < MEMBERS


def test_itae_starts_its_clock_at_every_event_and_activity_does_not(certificate):
    members = OPEN.fresh(LOOP, MEMBERS, jax.random.key(3))
    flown = jq.simulate(
        jq.Loop(members.plant, FIXED, drive=members.drive, delay=members.delay),
        members.flight(FLIGHT),
    )
    error = np.abs(np.asarray(flown.reference - flown.angle)[:, 0])
    half = len(error) // 2
    clock = 0.002 * np.arange(half)[:, None]
    itae = sum(
        np.trapezoid(clock * part, dx=0.002, axis=0) for part in (error[:half], error[half:])
    )
    found = certificate.design
    np.testing.assert_allclose(found.of("itae"), itae, rtol=1e-10)
    changes = np.sum(np.diff(np.asarray(flown.command)[:, 0], axis=0) ** 2, axis=0)
    np.testing.assert_allclose(found.of("activity"), changes, rtol=1e-10)
    np.testing.assert_allclose(found.of("activity_rate"), changes / 2.0, rtol=2e-3)
    angle = np.degrees(np.asarray(flown.angle)[:, 0])
    past = [np.max(angle[:half], axis=0) / 4 - 1, (4 - np.min(angle[half:], axis=0)) / 7 - 1]
    np.testing.assert_allclose(found.of("overshoot"), 100 * np.maximum(*past), rtol=1e-6, atol=1e-9)


def test_all_designs_meet_the_same_members_and_noise(certificate):
    own, twin = certificate.design, certificate.designs["twin"]
    for name, values in own.by_axis.items():
        np.testing.assert_array_equal(twin.by_axis[name], values)


def test_the_members_are_fresh_and_those_of_the_key(certificate):
    trained = OPEN.draw(LOOP, MEMBERS, jax.random.key(3))
    seen = np.asarray(trained.assumed_inertia)[0]
    assert not np.isin(certificate.facts["inertia"][0], seen).any()
    again = judged()
    np.testing.assert_array_equal(again.facts["inertia"], certificate.facts["inertia"])
    other = judged(key=jax.random.key(4))
    assert not np.isin(other.facts["inertia"], certificate.facts["inertia"]).any()
    assert certificate.provenance["key"] == jax.random.key_data(jax.random.key(3)).tolist()


def test_a_design_within_its_limits_says_what_that_proves():
    limits = (Limit("sensitivity_peak", at_most=10.0), Limit("phase_margin", at_least=0.1))
    slow = jq.LADRC(4.0, 20.0, 1.0)
    found = judged(slow, limits=limits, linear_members=190)
    assert found.stability.holds
    assert found.summaries["tuned"].unstable_at_most == upper_bound(0, MEMBERS)
    first, stability, performance, convergence = str(found).splitlines()[:4]
    assert first == (
        "CERTIFICATE OPEN on 24 fresh members (216 linear loops), not to be flown: PERFORMANCE is "
        "not decided"
    )
    assert stability == (
        "  OK   STABILITY: 216 of 216 members are stable and within the limits on Ms and phase "
        "margin (proven: at most 1.4 % of all are not, 95 % confidence); 24 of 24 flights are "
        "bounded (proven: at most 12 % of all are not, 95 % confidence)"
    )
    assert "worst: of 24 members; at most 12 % of all are beyond it" in str(found)
    few = "  --   PERFORMANCE: not decided, since 24 members are too few to speak of others; "
    assert performance.startswith(f"{few}24 of 24 members make less than half")
    assert convergence == "  --   CONVERGENCE: the gains were given, not tuned here"


def test_a_missed_limit_is_named_first_with_how_much_and_in_which_member():
    limits = (
        Limit("itae", at_most=np.radians(100.0), over=Mean()),
        Limit("sensitivity_peak", at_most=1.2),
        Limit("saturation_share", at_most=0.9, over=CVaR(0.2)),
    )
    slow = jq.LADRC(4.0, 20.0, 1.0)
    found = judged(slow, limits=limits)
    peak = found.design.of("sensitivity_peak")
    met, missed, _ = found.distances
    assert not found.holds and [d.met for d in found.distances] == [True, False, True]
    assert missed.slack == pytest.approx(1.2 - np.max(peak), rel=1e-12)
    assert missed.percent == pytest.approx(100 * missed.slack / 1.2, rel=1e-12)
    assert missed.member == np.argmax(peak) and missed.beyond == np.sum(peak > 1.2)
    assert met.reached == pytest.approx(np.mean(found.design.of("itae")), rel=1e-12)
    first, stability = str(found).splitlines()[:2]
    assert first == "CERTIFICATE FAILS on 24 fresh members, not to be flown: STABILITY"
    assert stability.startswith(
        f"  FAIL STABILITY: Ms, worst, at most 1.2: {np.max(peak):.4g}, "
        f"missed by {-missed.slack:.3g} ({-missed.percent:.2g} %)"
    )
    assert f"member {missed.member}: J {found.facts['inertia'][0, missed.member]:.3g}" in stability


def test_limits_of_the_linear_loop_count_members_that_do_not_fly():
    alone, many = (
        judged(limits=(Limit("sensitivity_peak", at_most=3.0),), linear_members=count)
        for count in (0, 48)
    )
    assert many.further is not None
    further, facts = many.further.design, many.further.facts
    assert further.members == 48 and set(further.by_axis) < set(many.design.by_axis)
    np.testing.assert_array_equal(many.design.of("itae"), alone.design.of("itae"))
    assert not np.isin(facts["inertia"], many.facts["inertia"]).any()
    gains, stable = (facts["torque_gain"] / facts["inertia"])[0], ~np.asarray(further.unstable)
    for gain, holds in zip(gains, stable, strict=True):
        poles = np.linalg.eigvals(ladrc_loop.loop(gain, 0.848)[0])
        assert (np.max(np.abs(poles)) < 1) == holds
    [mine], [theirs] = alone.distances, many.distances
    lost = np.sum(np.asarray(further.unstable) | (further.of("sensitivity_peak") > 3.0))
    assert theirs.members == 72 and theirs.beyond == mine.beyond + lost > mine.beyond
    assert theirs.beyond_at_most == upper_bound(int(theirs.beyond), 72)
    assert many.member(30)["inertia"] == facts["inertia"][:, 6]


def test_one_certified_member_beyond_a_limit_is_one_too_many():
    share = upper_bound(1, 2304)
    found = missed("sensitivity_peak", 3.0, 3.0001)
    found = found._replace(beyond=1, members=2304, without=0, beyond_at_most=share)
    assert not found.met
    assert "missed by 0.0001" in str(found) and "1 of 2304 members beyond" in str(found)


def test_an_unstable_member_fails_the_certificate_whatever_the_limits(certificate):
    unstable = judged(
        paper_designs(RIG)["paper b0 = 3"], limits=(Limit("phase_margin", at_least=0.1),)
    )
    count = certificate.designs["paper b0 = 3"].unstable_count
    assert not unstable.holds and unstable.distances[0].without == count
    stability = str(unstable.stability)
    assert f"FAIL STABILITY: {count} of 24 ({count / 24:.1%}) linearly unstable" in stability
    assert f"missed, {count} members are unstable" in stability
    row = unstable.summaries["tuned"].statistics["sensitivity_peak"]
    assert row.members == MEMBERS - count  # none of the unstable ones is in its mean


def test_a_limit_on_what_does_not_exist_is_not_met():
    still = jq.scenario(duration=2.0, axes=1)
    found = judged(flight=still, limits=(Limit("overshoot", at_most=5.0),))
    assert not found.holds and "not known" in str(found.stability)
    assert found.performance.holds is False and "moves nothing" in str(found.performance)


def test_a_bound_of_0_and_a_margin_that_is_any_are_printed_as_such():
    found = judged(
        jq.LADRC(4.0, 20.0, 1.0),
        limits=(Limit("saturation_share", at_most=0.0), Limit("gain_margin", at_least=1.5)),
    )
    assert "saturated, worst, at most 0 %: 0 %, met by 0 %" in str(found)
    any_gain = found.distances[1]._replace(reached=np.inf, slack=np.inf, percent=np.inf)
    assert str(any_gain).startswith("gain margin up, worst, at least 3.522 dB: any, met, 0 of 24")


def test_a_payload_counts_in_the_linear_loop():
    """LADRC(10, 30, 0.848) is stable for b/b0 from 0.216: not with six times the inertia."""
    carrying = lambda added: Ensemble(payload=Payload(added, at=0.5))
    assert judged(ensemble=carrying(5.0)).design.unstable_count == MEMBERS
    assert judged(ensemble=carrying(0.5)).stable


def test_members_that_were_given_prove_no_share():
    given = OPEN.draw(LOOP, MEMBERS, jax.random.key(3))
    found = judged(jq.LADRC(4.0, 20.0, 1.0), ensemble=given)
    assert found.stability.holds and found.summaries["tuned"].unstable_at_most is None
    assert "proven" not in str(found) and "fresh" not in str(found).splitlines()[0]


def test_a_certificate_is_written_with_every_member(tmp_path, certificate):
    path = write_json(tmp_path / "certificate.json", certificate.content())
    content = json.loads(path.read_text())
    assert content["certificate"] == str(certificate).splitlines()[0]
    assert content["per_member"]["tuned"]["itae"] == certificate.design.of("itae").tolist()
    assert content["provenance"]["controller"]["numbers"]["wc"] == 10.0
    assert any("inertia" in line for line in content["provenance"]["ensemble"])
    assert set(content["provenance"]["versions"]) == {"jaxquad", "jax", "jaxlib", "numpy"}


def test_a_peer_needs_a_name_of_its_own():
    with pytest.raises(ValueError, match="a peer has the name 'tuned'"):
        judged(peers={"tuned": FIXED})


def test_a_scheduled_design_is_flown_and_analysed_at_the_inertia_it_is_given(certificate):
    known = peers(RIG)["b0 = KT/J"]
    assert isinstance(known, ScheduledLADRC)
    found, inertia = certificate.designs["b0 = KT/J"], certificate.facts["inertia"]
    alone = judged(jq.LADRC(10.0, 30.0, 0.0468 / inertia))
    np.testing.assert_allclose(found.of("itae"), alone.design.of("itae"), rtol=1e-9)
    np.testing.assert_allclose(
        found.of("sensitivity_peak"), alone.design.of("sensitivity_peak"), rtol=1e-8
    )


def test_every_quantity_that_can_be_limited_is_computed_and_printed(certificate):
    for name, quantity in QUANTITIES.items():
        values = certificate.design.of(name, worst_axis=True)
        assert quantity.linear or not np.isnan(values).any()
        assert quantity.text(float(np.nanmax(values))) != "n/a"
    with pytest.raises(ValueError, match="'mass' was not computed: choose one of"):
        certificate.design.of("mass")


def test_a_loop_too_fast_for_its_lag_is_told_so():
    """wo/wc is 3; a PID has no such bound."""
    lag = lambda seconds: Ensemble(lag=seconds, delay=0.004)
    given = {"flight": BRIEF, "events": (), "members": 2}
    tight = {"limits": [Limit("sensitivity_peak", at_most=1.0)]}
    text = "; ".join(judged(FIXED, lag(0.05), **given).remarks)
    assert "50 ms x 10 rad/s = 0.5, 0.54 with the delay of 4 ms: too large, no b0" in text
    assert "beyond about 0.48 at wo/wc = 3. Reduce wc below 9.6 rad/s" in text
    slower = "; ".join(judged(FIXED, lag(0.01), **given, **tight).remarks)
    assert "= 0.1" in slower and "too large" not in slower and "Reduce wc" in slower
    other = judged(jq.PID(1.0, 1.0, 1.0), lag(0.05), **given, **tight)
    assert not any("lag x wc" in remark for remark in other.remarks)
