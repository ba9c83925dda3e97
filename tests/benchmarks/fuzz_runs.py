"""Kill `jaxquad`, fill its disk, damage its kept programs, name its files oddly; see what is left.

    python tests/benchmarks/fuzz_runs.py --seconds 60 --seed 0

Each case runs `jaxquad identify` on a simulated log under one attack, at a random moment or size.
BAD is a traceback, a result without its page or its figures, a draft that the next run leaves, an
exit code that is none of the help's, or a program that is compiled again at every run.
"""

import argparse
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from jaxquad.workflows import write_demo_log


WORDS = ("--input", "M", "--output", "q", "--unit", "q=rad/s", "--band", "0.5", "12", "--quiet")
WHOLE = {"result.json", "report.html", "record.png", "bode.png"}
NAMES = (b"\xff\xfebad.csv", b"gr\xc3\xbcn.csv", b"two\nlines.csv", b"\x1b[31m.csv", b"-x.csv")
LETTERS = ({"PYTHONIOENCODING": "ascii"}, {"PYTHONIOENCODING": "utf-8:strict"},
           {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"})  # fmt: skip
SECONDS = 2.5  # in which a warm run ends on an idle core


class Bad(AssertionError):
    """What an attack has left."""


class Place:
    """A folder with a log, kept programs and results."""

    def __init__(self, folder: Path, seed: int):
        self.folder, self.log = folder, write_demo_log(folder / "demo.csv")
        self.out, self.cache = folder / "out", folder / "programs"
        self.random = random.Random(seed)

    def start(self, *words: object, limit: int | None = None, **environment: str):
        def narrow() -> None:
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        command = [sys.executable, "-m", "jaxquad", *map(os.fsencode, map(str, words))]
        ours = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
        names = ours | {"JAXQUAD_CACHE": str(self.cache)} | environment
        return subprocess.Popen(
            command, cwd=self.folder, env=names, preexec_fn=narrow, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    def identify(self, *more: object, log: Path | None = None, **options) -> tuple[int, str]:
        words = ("identify", *WORDS, "--out", self.out, *more, "--", log or self.log)
        process = self.start(*words, **options)
        printed = b"\n".join(process.communicate(timeout=300)).decode("utf-8", "replace")
        return process.returncode, printed

    def check(self, code: int, printed: str, codes: tuple[int, ...] = (0, 3)) -> None:
        if "Traceback" in printed or code not in codes:
            raise Bad(f"exit code {code}: {printed[-1500:]}")
        left = {path.name for path in self.out.iterdir()} if self.out.exists() else set()
        if "result.json" in left and not left >= WHOLE:
            raise Bad(f"a result without its page: {sorted(left)}")
        if code in (0, 3) and left != WHOLE:
            raise Bad(f"there is {sorted(left)}, not {sorted(WHOLE)}")


def kill(place: Place) -> None:
    """At any moment, without a chance to clear up."""
    process = place.start("identify", *WORDS, "--out", place.out, place.log)
    time.sleep(place.random.uniform(0.3, 1.5) * SECONDS)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    if (place.out / "result.json").exists() and not {x.name for x in place.out.iterdir()} >= WHOLE:
        raise Bad("a result without its page")
    place.check(*place.identify())


def interrupt(place: Place) -> None:
    """At any moment, as Ctrl-C does: to all processes of the terminal."""
    logs = place.folder / "logs"
    logs.mkdir(exist_ok=True)
    shutil.copy(place.log, logs)
    words = ("batch", logs, "--out", place.folder / "batch", "--quiet")
    process = place.start(*place.random.choice([words, ("identify", *WORDS, place.log)]))
    time.sleep(place.random.uniform(0.1, 1.2) * SECONDS)
    os.killpg(process.pid, signal.SIGINT)
    printed = b"\n".join(process.communicate()).decode()
    # Python itself starts in the first tenth of a second, on a busy machine later.
    if "Traceback" in printed and "jaxquad" in printed:
        raise Bad(printed[-1500:])
    shutil.rmtree(place.folder / "batch", ignore_errors=True)


def fill_disk(place: Place) -> None:
    """A file that cannot grow, as on a disk that is full."""
    before = place.out.exists()
    limit = place.random.choice([0, 1000, 10_000, 50_000, 100_000, 200_000])
    code, printed = place.identify(limit=limit, JAXQUAD_CACHE="off")
    place.check(code, printed, (0, 2, 3))
    if code == 2 and (str(place.out) not in printed or place.out.exists() > before):
        raise Bad(f"the folder is not named, or left: {printed[-500:]}")
    shutil.rmtree(place.out, ignore_errors=True)


def damage_programs(place: Place) -> None:
    """Kept programs are cut, flipped, emptied, or folders."""
    if not list(place.cache.glob("*-cache")):
        place.identify()
    entries, damaged = sorted(place.cache.glob("*-cache")), {}
    for path in place.random.sample(entries, max(1, len(entries) // 2)):
        content = bytearray(path.read_bytes())
        how = place.random.choice(["cut", "flip", "empty", "folder"])
        path.unlink()
        if how == "folder":
            path.mkdir()
            damaged[path] = None
            continue
        for _ in range(8 if how == "flip" else 0):
            content[place.random.randrange(len(content))] ^= 1 << place.random.randrange(8)
        end = {"cut": place.random.randrange(len(content)), "empty": 0}.get(how, len(content))
        damaged[path] = bytes(content[:end])
        path.write_bytes(damaged[path])
    code, printed = place.identify("--force")
    place.check(code, printed)
    for path, content in damaged.items():
        if path.exists() and (None if path.is_dir() else path.read_bytes()) == content:
            raise Bad(f"a damaged program stays: {path}")
    if printed.count("a kept program was damaged") != 1:
        raise Bad(f"one line was to say so: {printed[-500:]}")
    first = {path.name: path.stat().st_mtime_ns for path in place.cache.glob("*-cache")}
    began = time.time()
    place.check(*place.identify("--force"))
    second = {path.name: path.stat().st_mtime_ns for path in place.cache.glob("*-cache")}
    if first != second:
        raise Bad(f"compiled again: {sorted(set(first.items()) ^ set(second.items()))}")
    # That of a process which another attack has killed goes 60 s after its last write.
    folders = place.cache.glob("process-*")
    if left := [path for path in folders if path.stat().st_mtime < began - 60]:
        raise Bad(f"folders of processes are left: {left}")


def name_oddly(place: Place) -> None:
    """Names of files that are no text, or no letters of the terminal."""
    name = os.fsdecode(place.random.choice(NAMES))
    log = place.folder / name
    shutil.copy(place.log, log)
    place.check(*place.identify("--force", log=log, **place.random.choice(LETTERS)))
    log.unlink()


ATTACKS: tuple[Callable[[Place], None], ...] = (
    kill, interrupt, fill_disk, damage_programs, name_oddly,
)  # fmt: skip


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Attack runs of jaxquad.")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    begin, counts, bad = time.monotonic(), Counter[str](), 0
    with tempfile.TemporaryDirectory() as folder:
        place = Place(Path(folder), options.seed)
        place.identify()
        while not counts or time.monotonic() < begin + options.seconds:
            attack = ATTACKS[counts.total() % len(ATTACKS)]
            counts[attack.__name__] += 1
            try:
                attack(place)
            except Bad as error:
                bad += 1
                print(f"BAD {attack.__name__}: {error}")
    print(f"seed {options.seed}: {dict(counts)}, {bad} bad")
    return bad


if __name__ == "__main__":
    sys.exit(main())
