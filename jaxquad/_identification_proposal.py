"""What the log of an autopilot says of the channels that the user did not name."""

from argparse import Namespace
from typing import Any

import numpy as np

from .records import propose
from .records._proposal import Proposal


def with_proposal(options: Namespace) -> Namespace:
    """Options with input and output, and the proposal printed where they come from it.

    What the user gave stays. Raises ValueError where only one of the two is given, or an axis
    beside them, and what `propose` raises.
    """
    if options.input and options.output:
        if options.axis:
            raise ValueError("--axis is for a proposal: leave it out, or --input and --output")
        return options
    if options.input or options.output:
        raise ValueError("--input and --output belong together: give both, or none to be proposed")
    proposal = propose(options.file, axis=options.axis)
    print(f"{proposal}\n")
    offered = proposal.options
    one = lambda name: {name: {name: 1.0}} if name else None
    found = {"input": offered["inputs"], "output": one(offered["outputs"]), "axis": None}
    if options.reference is None:
        found["reference"] = one(offered["references"])
    if options.rate is None:
        found["rate"] = offered["sample_rate"]
    if proposal.setup.band and not (options.band or options.band_rad):
        found["band"] = list(proposal.setup.band)
    return Namespace(**(vars(options) | found | _span(options, proposal)))


def _span(options: Namespace, proposal: Proposal) -> dict[str, Any]:
    """All injections that were found, or what of them lies where the user says to look."""
    if options.segment:
        return {}
    low = -np.inf if options.start is None else options.start
    high = np.inf if options.stop is None else options.stop
    inside = [(max(start, low), min(stop, high)) for start, stop in proposal.segments]
    spans = [(start, stop) for start, stop in inside if start < stop]
    if len(spans) > 1:
        return {"segment": spans, "start": None, "stop": None}
    return dict(zip(("start", "stop"), spans[0], strict=True)) if spans else {}
