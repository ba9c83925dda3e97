"""What a long computation begins with next, for those who wait for it."""

import logging


STAGES = logging.getLogger("jaxquad.stages")


def announce(stage: str) -> None:
    """Log what begins now, at level INFO; the command line shows it on stderr."""
    STAGES.info(stage)
