"""The records that the options of `jaxquad identify` stand for."""

from argparse import Namespace
from collections.abc import Sequence

from ._mixed_record import read_segments, Segment
from .records import Record


def records_of(options: Namespace) -> list[Record]:
    """One for each segment. Raises RecordError, ReadError."""
    asked = {*options.input, *options.output, *(options.reference or {})}
    return read_segments(
        options.file,
        _segments(options),
        inputs=options.input,
        outputs=options.output,
        references=options.reference,
        sample_rate=options.rate,
        time=options.time,
        time_unit=options.time_unit,
        units={name: unit for name, unit in options.unit if name in asked},
    )


def _segments(options: Namespace) -> Sequence[Segment]:
    if not options.segment:
        return [(options.start, options.stop)]
    if options.start is not None or options.stop is not None:
        raise ValueError("--segment says where to start and stop: leave --start and --stop out")
    return [(float(start), float(stop)) for start, stop in options.segment]


def described(records: Sequence[Record]) -> str:
    """All of them as they are printed; the channels once."""
    first, *others = map(str, records)
    return "\n".join([first, *(f"and {text.splitlines()[1].strip()}" for text in others)])
