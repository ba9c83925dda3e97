"""What several commands share: how a command is declared, and how results are shown."""

import argparse
import atexit
import contextlib
import gc
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from jaxquad.workflows import (
    AutopilotSettings,
    BatchSettings,
    free_folder,
    GROUPS,
    IdentifySettings,
    TuneSettings,
)


Run = Callable[[argparse.Namespace], int]
Settings = (
    type[AutopilotSettings] | type[IdentifySettings] | type[TuneSettings] | type[BatchSettings]
)
S = TypeVar("S", AutopilotSettings, IdentifySettings, TuneSettings, BatchSettings)
Group = argparse._ArgumentGroup
Commands = Any  # argparse names the type of its subparsers nowhere public


class Command(NamedTuple):
    """A command of `jaxquad`: its name, what its help says, its options, and what it does."""

    name: str
    help: str
    examples: str  # the first line of commands is the one that `jaxquad --help` shows
    add: Callable[[argparse.ArgumentParser], None]
    run: Run

    @property
    def example(self) -> str:
        return self.examples.splitlines()[1].strip()

    def declare(self, commands: Commands) -> None:
        declared = commands.add_parser(
            self.name,
            prog=f"jaxquad {self.name}",
            description=self.help,
            epilog=self.examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        declared.set_defaults(run=self.run)
        self.add(declared)


def add_log(declared: argparse.ArgumentParser) -> None:
    declared.add_argument("file", type=Path, help="a log of an autopilot, CSV, NPZ, MAT, HDF5, ...")


def add_result(declared: argparse.ArgumentParser) -> None:
    declared.add_argument("result", type=Path, help="the folder, or result.json, of identify")


def add_log_option(declared: argparse.ArgumentParser) -> None:
    text = "the log that was identified, if it was moved"
    declared.add_argument("--log", type=Path, metavar="FILE", help=text)


def add_out(declared: Group, default: str) -> None:
    text = f"where to write; by default {default}"
    declared.add_argument("--out", type=Path, metavar="FOLDER", help=text)
    declared.set_defaults(out_is_folder=True)


def check_out(options: argparse.Namespace) -> None:
    """Raise ValueError where --out cannot be written, before anything is computed for it."""
    out: Path | None = getattr(options, "out", None)
    if out is None:
        return
    folder = getattr(options, "out_is_folder", False)
    if out.is_dir() and not folder:
        raise ValueError(f"--out is {out}, which is a folder: name a file in it")
    if out.exists() and not (out.is_dir() or out.is_file() and not folder):
        raise ValueError(f"--out is {out}, which is no {'folder' if folder else 'regular file'}")
    beside = [out, *out.parents] if folder else out.absolute().parents
    place = next((each for each in beside if each.exists()), Path())
    if not place.is_dir():
        raise ValueError(f"--out is {out}, but {place} is a file: name another folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise ValueError(f"--out is {out}, but nothing may be written to {place}")


def add_force(declared: Group) -> None:
    text = "overwrite the result of other settings; without it, that is kept, and FOLDER-2 written"
    declared.add_argument("--force", action="store_true", help=text)


def folder_to_write(
    options: argparse.Namespace,
    wanted: Path,
    name: str,
    same: Mapping[str, object],
    sources: Sequence[Path | str],
) -> Path:
    """The folder that is wanted, or one beside it where that holds the result of other settings."""
    if options.force:
        return wanted
    folder = free_folder(wanted, name, same, sources=sources)
    if folder != wanted:
        print(
            f"! {wanted} holds the result of other settings or of another file, and is kept: this "
            f"result is in {folder} (--force writes into {wanted})",
            file=sys.stderr,
        )
    return folder


def add_output(declared: argparse.ArgumentParser) -> Group:
    """Where the options on output go, last in the help of a command."""
    return declared.add_argument_group("output")


def add_json(declared: Group, what: str) -> None:
    text = f"print {what} as JSON to stdout, everything else to stderr"
    declared.add_argument("--json", action="store_true", help=text)


def add_config(declared: argparse.ArgumentParser) -> None:
    text = "a file of settings; options take precedence"
    declared.add_argument("--config", type=Path, metavar="TOML", help=text)


def add_settings(
    declared: argparse.ArgumentParser, settings: Settings, *, only: Mapping[str, str] | None = None
) -> None:
    """Declare an option for each setting; an option that is not given stays out of the result.

    `only` names the settings that are declared, each with its own help or "".
    """
    chosen = {k: o for k, o in settings.options().items() if only is None or k in only}
    used = list(dict.fromkeys(option.group for option in chosen.values()))
    used.sort(key=lambda title: GROUPS.index(title) if title in GROUPS else len(GROUPS))
    groups = {title: declared.add_argument_group(title) if title else declared for title in used}
    for key, option in chosen.items():
        group, kind = groups[option.group], option.kind
        how: dict[str, Any] = {
            "dest": key,
            "default": argparse.SUPPRESS,
            "help": (only or {}).get(key) or option.help,
        }
        if kind.words == 0:
            on = f"store_{'false' if option.flag.startswith('--no-') else 'true'}"
            group.add_argument(option.flag, action=on, **how)
            continue
        how |= {"type": kind.read, "metavar": kind.metavar, "choices": kind.choices}
        how |= {"nargs": kind.words} if kind.words > 1 else {}
        how |= {"action": "append"} if kind.repeated else {}
        how |= {"action": _Once} if key in ("input", "output", "reference") else {}
        group.add_argument(option.flag, **how)


class _Once(argparse.Action):
    """A channel that is named twice would silently be the second one."""

    def __call__(self, parser, namespace, values, option_string=None):
        if self.dest in namespace:
            raise argparse.ArgumentError(self, "given twice: one input moves one output at a time")
        setattr(namespace, self.dest, values)


def given_settings(options: argparse.Namespace, settings: Settings) -> dict[str, object]:
    """Those that were given on the command line."""
    keys = settings.options()
    return {key: value for key, value in vars(options).items() if key in keys}


def settings_of(options: argparse.Namespace, settings: type[S]) -> S:
    """The settings of a TOML file, if there is one, changed by the options."""
    given = given_settings(options, settings)
    if options.config is None:
        return settings.from_mapping(given)
    return settings.from_toml(options.config).changed(given)


def start_computing() -> None:
    """JAX in 64 bits, and programs that are kept for the next call.

    What a command can say without JAX it says before.
    """
    atexit.register(gc.freeze)  # Python's last look for garbage takes half a second
    from jaxquad._compile import enable_compile_cache
    from jaxquad._core import enable_x64

    enable_x64()
    enable_compile_cache()


@contextlib.contextmanager
def stdout_for_json(options: argparse.Namespace) -> Iterator[None]:
    """With --json, stdout belongs to the JSON alone, and what is printed goes to stderr."""
    with contextlib.redirect_stdout(sys.stderr if options.json else sys.stdout):
        yield


def print_json(content: object) -> None:
    from jaxquad._core import plain_content

    print(json.dumps(plain_content(content), indent=2, allow_nan=False))


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """The first row is the heading; the first column is of words, the others of numbers."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for name, *cells in rows:
        padded = (f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=True))
        print("  ".join((f"{name:<{widths[0]}}", *padded)).rstrip())
