"""Compiled programs are kept for the next process by the command line, and by nobody's import."""

import json
import os
import subprocess
import sys
import time
import zlib

import pytest

from jaxquad._compile import _door


COMPILE = """
import json, sys, time, jax, jax.numpy as jnp
import jaxquad as jq

jq.fit, jq.simulate
folder = lambda: jax.config.values["jax_compilation_cache_dir"]
imported, hits = folder(), []
jax.monitoring.register_event_listener(lambda name, **_: hits.append("cache_hits" in name))
jax.config.update("jax_raise_persistent_cache_errors", True)
jax.jit(lambda x: x - 1)(1.0)  # what was compiled before does not matter
returned = jq.enable_compile_cache()
assert jq.enable_compile_cache() == returned
for k in range(int(sys.argv[1])):
    jax.block_until_ready(jax.jit(lambda x: jnp.sin(x + k))(1.0))
print(json.dumps([imported, returned and str(returned), folder(), sum(hits)]))
"""
COMMAND = """
import jax
from jaxquad.cli import main
assert main(["identify", "log.csv", "--input", "u", "--output", "y", "--quiet"]) == 2
print(jax.config.values["jax_compilation_cache_dir"])
"""


def started(program, *words, cwd, **environment):
    """A process that is started, without the folder that the tests give JAX."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", program, *words],
        env=inherited | environment,
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def answer(process):
    said, complaints = process.communicate(timeout=100)
    assert process.returncode == 0, complaints
    return said


@pytest.mark.slow
def test_processes_at_once_leave_whole_programs_for_the_next(tmp_path):
    shared = tmp_path / "programs"
    shared.mkdir()
    with open(shared / "old-cache", "wb") as large:
        large.truncate(300 * 2**20)
    abandoned = shared / "process-killed"
    abandoned.mkdir()
    for path in (shared / "old-cache", abandoned):
        os.utime(path, (time.time() - 1e6, time.time() - 1e6))
    both = [started(COMPILE, "3", cwd=tmp_path, JAXQUAD_CACHE=str(shared)) for _ in range(2)]
    for imported, returned, own, _ in map(json.loads, map(answer, both)):
        assert imported is None and returned == str(shared) and own.startswith(f"{shared}/process")
    names = {path.name for path in shared.iterdir()}
    assert names and all(name.endswith("-cache") and name != "old-cache" for name in names)
    after = json.loads(answer(started(COMPILE, "3", cwd=tmp_path, JAXQUAD_CACHE=str(shared))))
    assert after[-1] >= 3 and {path.name for path in shared.iterdir()} == names


def test_the_folder_of_a_killed_process_goes_and_that_of_a_living_one_stays(tmp_path):
    folders = [tmp_path / f"process-{name}" for name in ("killed", "alive", "young")]
    for folder in folders:
        folder.mkdir()
    for folder in folders[:2]:
        os.utime(folder, (time.time() - 100, time.time() - 100))
    lock = _door._locked(folders[1])
    assert lock is not None
    try:
        _door._prune(tmp_path)
    finally:
        os.close(lock)
    assert sorted(tmp_path.iterdir()) == sorted(folders[1:])


def test_damaged_entries_are_removed_with_one_warning_each(tmp_path):
    mine = tmp_path / "process-mine"
    mine.mkdir()
    content = b"a program"
    sound = tmp_path / f"{zlib.crc32(content):08x}.jit_f-1-cache"
    sound.write_bytes(content)
    damaged = tmp_path / f"{zlib.crc32(b'another'):08x}.jit_f-2-cache"
    damaged.write_bytes(content)
    (tmp_path / "traced-g-cache").mkdir()
    _door._link_entry(sound, mine)
    for path in (damaged, tmp_path / "traced-g-cache"):
        with pytest.warns(UserWarning, match="damaged: it is removed and compiled again"):
            _door._link_entry(path, mine)
    assert sorted(tmp_path.iterdir()) == [sound, mine]
    assert [path.name for path in mine.iterdir()] == ["jit_f-1-cache"]


@pytest.mark.slow
def test_the_cache_is_switched_off_or_the_users_own(tmp_path):
    off = started(COMPILE, "0", cwd=tmp_path, JAXQUAD_CACHE="off")
    own = started(COMPILE, "0", cwd=tmp_path, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "own"))
    assert json.loads(answer(off))[:3] == [None, None, None]
    assert json.loads(answer(own))[:3] == [str(tmp_path / "own")] * 3


@pytest.mark.slow
def test_the_command_line_keeps_what_it_compiles(tmp_path):
    rows = "".join(f"{k / 100},{k % 7},{k % 5}\n" for k in range(16))
    (tmp_path / "log.csv").write_text(f"time,u,y\n{rows}")
    folder = answer(started(COMMAND, cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path))).strip()
    assert folder.startswith(f"{tmp_path}/jaxquad/programs-")
    assert not os.path.exists(folder), "the process removes its own folder"
