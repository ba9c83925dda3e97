"""What several commands share: how a command is declared, and how results are shown."""

import argparse
import atexit
import contextlib
import gc
import json
import logging
import os
import re
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from jaxquad._core import readable, STAGES
from jaxquad.workflows import free_folder, GROUPS, Settings


Run = Callable[[argparse.Namespace], int]
S = TypeVar("S", bound=Settings)
Declare = Callable[[argparse.ArgumentParser], Run]  # declares options; what it returns runs


class Command(NamedTuple):
    """A command of `jaxquad`: what its help says, and what declares its options."""

    name: str
    help: str
    examples: str  # the first line of commands is the one that `jaxquad --help` shows
    declare: Declare


def command(help: str, examples: str) -> Callable[[Declare], Command]:
    """Makes a command of the function that declares it."""
    return lambda declare: Command(declare.__name__, help, examples, declare)


_SHARED = {
    "file": (None, "a log of an autopilot, CSV, NPZ, MAT, HDF5, ..."),
    "result": (None, "the folder, or result.json, of identify"),
    "--log": ("FILE", "the log that was identified, if it was moved"),
    "--config": ("TOML", "a file of settings; options take precedence"),
}


def add_paths(declared: argparse.ArgumentParser, *names: str) -> None:
    """Arguments that several commands take."""
    for name in names:
        metavar, text = _SHARED[name]
        declared.add_argument(name, type=Path, metavar=metavar, help=text)


_FORCE = "overwrite the result of other settings; without it, that is kept, and FOLDER-2 written"


def add_output(
    declared: argparse.ArgumentParser, content: str, *, folder: str = "",
    file: tuple[str, str] | None = None, force: str = _FORCE, quiet: bool = True,
) -> None:  # fmt: skip
    """Options on output, last in the help of a command: `content` is what --json prints, `folder`
    where the command writes by default, `file` instead placeholder and help of one."""
    add = declared.add_argument_group("output").add_argument
    if folder:
        text = f"where to write; by default {folder}"
        add("--out", type=Path, metavar="FOLDER", help=text)
        declared.set_defaults(out_is_folder=True)
    elif file is not None:
        add("--out", type=Path, metavar=file[0], help=file[1])
    if force:
        add("--force", action="store_true", help=force)
    text = f"print {content} as JSON to stdout, everything else to stderr"
    add("--json", action="store_true", help=text)
    if quiet:
        add("--quiet", action="store_true", help="do not show on stderr what is being done")


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
    parents = [out, *out.parents] if folder else out.absolute().parents
    place = next((parent for parent in parents if parent.exists()), Path())
    if not place.is_dir():
        raise ValueError(f"--out is {out}, but {place} is a file: name another folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise ValueError(f"--out is {out}, but nothing may be written to {place}")


@contextlib.contextmanager
def folder_to_write(
    options: argparse.Namespace, wanted: Path, name: str, same: Mapping[str, object],
    sources: Sequence[Path | str],
) -> Iterator[Path]:  # fmt: skip
    """The folder that is wanted, or one beside it where that holds the result of other settings.

    Another `jaxquad` that wants to write there waits until this one has written, or died.
    """
    wanted.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as lock:
        # Windows has no locks, some disks neither; a folder may not be readable.
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            place = os.open(wanted.parent, os.O_RDONLY)
            lock.callback(os.close, place)
            fcntl.flock(place, fcntl.LOCK_EX)
        folder = wanted if options.force else free_folder(wanted, name, same, sources=sources)
        if folder != wanted:
            text = f"! {wanted} holds the result of other settings or of another file, and is kept:"
            text += f" this result is in {folder} (--force writes into {wanted})"
            print(readable(text), file=sys.stderr)
        for draft in folder.glob(".*.part"):  # of a process that was killed
            shutil.rmtree(draft, ignore_errors=True)
        yield folder


class _NamedOnce(argparse.Action):
    """A channel that is named twice would silently be the second one."""

    def __call__(self, parser, namespace, values, option_string=None):
        if self.dest in namespace:
            raise argparse.ArgumentError(self, "given twice: one input moves one output at a time")
        setattr(namespace, self.dest, values)


def add_settings(
    declared: argparse.ArgumentParser, settings: type[Settings], *,
    only: Mapping[str, str] | None = None,
) -> None:  # fmt: skip
    """Declare an option for each setting, or for those in `only`, each with its own help or ""."""
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
        read = str.lower if kind.choices and kind.read is str else kind.read
        how |= {"type": read, "metavar": kind.metavar, "choices": kind.choices}
        how |= {"nargs": kind.words} if kind.words > 1 else {}
        how |= {"action": "append"} if kind.repeated else {}
        how |= {"action": _NamedOnce} if key in ("input", "output", "reference") else {}
        group.add_argument(option.flag, **how)


def typed_settings(options: argparse.Namespace, settings: type[Settings]) -> dict[str, object]:
    return {key: value for key, value in vars(options).items() if key in settings.options()}


def settings_of(options: argparse.Namespace, settings: type[S]) -> S:
    """The settings of a TOML file, if there is one, changed by the options."""
    typed = typed_settings(options, settings)
    if options.config is None:
        return settings.from_mapping(typed)
    return settings.from_toml(options.config).changed(typed)


@contextlib.contextmanager
def _interrupts_wait() -> Iterator[None]:
    """JAX's libraries abort the process where an interrupt comes while they load."""
    usual = signal.getsignal(signal.SIGINT)
    if not callable(usual) or threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
    if came:
        raise KeyboardInterrupt


def start_computing() -> None:
    """JAX in 64 bits, and programs that are kept; what can be said without JAX is said before."""
    atexit.register(gc.freeze)  # Python's last look for garbage takes half a second
    with _interrupts_wait():
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


@contextlib.contextmanager
def shown_stages(options: argparse.Namespace) -> Iterator[None]:
    """Within it, each stage that takes longer than 1 s is a line on stderr, without --quiet."""
    if vars(options).get("quiet", True):
        yield
        return
    shown, level = _Stages(), STAGES.level
    STAGES.addHandler(shown)
    STAGES.setLevel(logging.INFO)
    try:
        yield
    finally:
        STAGES.removeHandler(shown)
        STAGES.setLevel(level)
        shown.forget()


class _Stages(logging.Handler):
    """Prints the stage that runs once it has run for a second."""

    waiting: threading.Timer | None = None

    def emit(self, record: logging.LogRecord) -> None:
        self.forget()
        text = f"{record.getMessage()} ..."
        self.waiting = threading.Timer(1.0, print, [text], {"file": sys.stderr})
        self.waiting.daemon = True
        self.waiting.start()

    def forget(self) -> None:
        if self.waiting is not None:
            self.waiting.cancel()


_MOST = 15  # rows of a table in parts; of longer ones each row has several lines
_CELLS = re.compile(r"\S {2,}\S")  # of a line of a table; prose has single blanks


def print_text(text: object) -> None:
    """Print, and fold tables to the width of the terminal where stdout is one.

    Prose stays as it is: the terminal wraps it, and a command in it can be copied.
    """
    shown = str(text)
    width = shutil.get_terminal_size().columns
    print(fold_tables(shown, width) if sys.stdout.isatty() else shown, flush=True)


def fold_tables(text: str, width: int) -> str:
    """The text with each table that is wider than `width` in parts of its columns."""
    lines: list[str] = []
    for is_table, group in groupby(text.split("\n"), lambda line: bool(_CELLS.search(line))):
        rows = list(group)
        lines += _folded(rows, width) if is_table and max(map(len, rows)) > width else rows
    return "\n".join(lines)


def _folded(rows: Sequence[str], width: int) -> Iterator[str]:
    columns = _columns(rows)
    if len(columns) < 2:
        yield from rows
        return
    (_, first), *others = columns
    parts: list[list[slice]] = []
    for start, stop in others:
        if not parts or first + stop - parts[-1][0].start > width:
            parts.append([])
        parts[-1].append(slice(start, stop))
    places = [slice(part[0].start, part[-1].stop) for part in parts]
    named = lambda row, inside, name: f"{name:<{first}}{row[inside]}".rstrip()
    if len(rows) > _MOST:
        for row in rows:
            yield named(row, places[0], row[:first])
            yield from (named(row, inside, "") for inside in places[1:])
        return
    for number, inside in enumerate(places):
        if number:
            yield ""
        yield from (named(row, inside, row[:first]) for row in rows)


def _columns(rows: Sequence[str]) -> list[tuple[int, int]]:
    """Where columns begin and end, each with the blanks before it: two or more in every row."""
    size = max(map(len, rows))
    padded = [row.ljust(size) for row in rows]
    blank = "".join(" " if all(row[k] == " " for row in padded) else "x" for k in range(size))
    ends = [0, *(gap.start() for gap in re.finditer(r"(?<=x) {2,}(?=x)", blank)), size]
    return list(zip(ends[:-1], ends[1:], strict=True))
