"""Certificates of numbers that were made up, without a flight."""

from typing import Any

import numpy as np

from jaxquad.tuning import Certificate, DesignResult, Distance, Pareto


MEMBERS = 12
INERTIA = np.geomspace(0.5, 3.0, MEMBERS)  # times J0


def judged(itae: Any = 1.0, peak=2.0, activity=10.0, unstable: Any = ()):
    """One axis; ITAE in deg s^2; the `unstable` members have no Ms."""
    which = np.isin(np.arange(MEMBERS), unstable)
    wide = lambda x: np.array(np.broadcast_to(np.asarray(x, float), (1, MEMBERS)))
    by_axis = {
        "itae": np.radians(wide(itae)),
        "overshoot": wide(1.0),
        "saturation_share": wide(0.0),
        "activity_rate": wide(activity),
        "abscissa": np.where(which, 0.5, wide(-1.0)),
        "sensitivity_peak": np.where(which, np.nan, wide(peak)),
        "gain_margin": np.where(which, np.nan, wide(2.0)),
    }
    return DesignResult(by_axis, which, np.zeros(MEMBERS, bool), np.zeros(MEMBERS, bool))


IDLE_ITAE = 100.0  # deg s^2


def certificate(designs, distances=()):
    shape = (1, MEMBERS)
    facts = {"inertia": 0.05 * INERTIA[None], "torque_gain": np.full(shape, 0.05)}
    facts |= {
        "lag": np.full(shape, 0.02),
        "delay": np.zeros(shape),
        "assumed_inertia": np.ones(shape),
    }
    return Certificate(
        designs, tuple(distances), facts, np.array([0.05]),
        {
            "members": MEMBERS, "linear_members": 0, "fresh": True, "sampling": "random",
            "key": [0, 0],
            "precision": "float64", "ensemble": None, "device": "cpu", "versions": {},
        },
        (),
        idle=judged(itae=IDLE_ITAE),
    )  # fmt: skip


def missed(quantity, bound, found):
    """A limit on the worst that is missed."""
    slack = bound - found
    return Distance(
        quantity, "worst", "at most", bound, found, slack, 100 * slack / bound, 3, 0, found,
        MEMBERS, 4,
    )  # fmt: skip


def front(points, over="activity_rate", peers=None):
    """A front of designs."""
    count = len(points)
    return Pareto(
        over=over,
        levels=np.geomspace(1, 100, count),
        controllers=(None,) * count,
        certificates=tuple(certificate({"tuned": design}) for design in points),
        peers=peers or {},
        converged=np.ones(count, bool),
        evaluations=np.full(count, 9),
        seconds=1.0,
    )
