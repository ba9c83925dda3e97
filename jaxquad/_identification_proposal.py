"""What the log of an autopilot says of the channels that the user did not name."""

from argparse import Namespace

from .records import propose


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
    banded = options.band or options.band_rad
    band = None if banded or not proposal.setup.band else list(proposal.setup.band)
    found = {"input": offered["inputs"], "output": one(offered["outputs"]), "axis": None}
    if options.reference is None:
        found["reference"] = one(offered["references"])
    for name, value in {"rate": offered["sample_rate"], "start": offered["start"],
                        "stop": offered["stop"]}.items():  # fmt: skip
        if getattr(options, name) is None:
            found[name] = value
    return Namespace(**(vars(options) | found | ({"band": band} if band else {})))
