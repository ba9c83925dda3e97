"""Identifying one log of 20 s after the other in one process: seconds of processor and programs.

    python -m pytest tests/benchmarks/test_batch_of_logs.py -o addopts= -s

Lengths differ by some samples, as those of logs do. Each gets its report and figures, as
`jaxquad batch` makes them.
"""

import time

import jax
import numpy as np

import jaxquad as jq
from jaxquad.workflows import identify, IdentifySettings


jax.config.update("jax_enable_x64", True)

RATE, SAMPLES = 250.0, (5000, 5013, 4950, 5100, 4987)


def write_log(path, number: int, samples: int) -> None:
    sweep = jq.sweep(1.0, 40.0, duration=20.0, sample_rate=RATE, amplitude=0.2)
    command = np.resize(sweep.signal, samples)
    model = jq.LaggedIntegrator(100.0 * (1 + 0.05 * number), 0.02, 0.01).transfer_function()
    rate = np.asarray(jq.models.simulate_linear(model, command, 1 / RATE))
    rate = rate + np.random.default_rng(number).normal(0, 0.05, samples)
    table = np.column_stack([np.arange(samples) / RATE, command, rate])
    np.savetxt(path, table, delimiter=",", header="t,M,q", comments="")


def test_logs_after_the_first(tmp_path):
    compiled, used = [], []

    def listen(event: str, duration_secs: float, **facts: str | int):
        if "backend_compile" in event:
            compiled.append(facts.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(listen)
    for number, samples in enumerate(SAMPLES):
        log = tmp_path / f"{number}.csv"
        write_log(log, number, samples)
        before, began = len(compiled), time.process_time()
        found = identify(str(log), IdentifySettings(input="M", output="q"))
        found.write(tmp_path / f"{number}")
        used.append((time.process_time() - began, len(compiled) - before))
        assert found.fit.identifiable
    (first, programs), *others = used
    print(
        f"logs of 20 s: the first {first:.1f} s of processor with {programs} programs, the others "
        f"{np.median([each for each, _ in others]):.2f} s with {max(n for _, n in others)}"
    )
