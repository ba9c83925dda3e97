"""`jaxquad`: from a flight record to an identified model, on the command line."""

import argparse
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from . import _batch, _channels, _demo, _design, _identify, _report, _tune, _verify


_COMMANDS = (_demo, _channels, _identify, _verify, _report, _tune, _design, _batch)
_CODES = """exit codes:
  0  done
  2  the input or the options cannot be used
  3  the record does not determine the parameters
  4  some logs of a batch failed; a certificate fails; an excitation breaks a guideline
  130  interrupted
"""
_UNUSABLE, _NOT_IDENTIFIABLE, _INTERRUPTED = 2, 3, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, see `jaxquad --help`."""
    options = _parser().parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxquad.identify import UndeterminedError
    from jaxquad.records import RecordWarning

    with warnings.catch_warnings():
        warnings.simplefilter("always", RecordWarning)
        warnings.showwarning = _warn
        try:
            return options.run(options)
        except (ValueError, OSError) as error:
            print("jaxquad: error:", *str(error).split(), file=sys.stderr)
            return _NOT_IDENTIFIABLE if isinstance(error, UndeterminedError) else _UNUSABLE
        except KeyboardInterrupt:
            print("jaxquad: interrupted", file=sys.stderr)
            return _INTERRUPTED


def _warn(message: Warning | str, *_: Any) -> None:
    print("!", *str(message).split(), file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxquad",
        description="From a flight record to an identified model with honest error bars.",
        epilog="\n".join((*(each.EXAMPLES.split("\n\n")[0] for each in _COMMANDS), _CODES)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('jaxquad')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for each in _COMMANDS:
        each.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
