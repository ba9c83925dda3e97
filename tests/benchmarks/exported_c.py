"""Time of a sample in exported C: the Fourier estimator's update beside a LADRC's step, three axes.

python tests/benchmarks/exported_c.py
"""

import subprocess
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np

import jaxquad as jq
from jaxquad.control import FourierInertia, LADRC
from jaxquad.export import write_c_header


AXES, TONES, DT = 3, 8, 0.002
_PROGRAM = """
#include <stdio.h>
#include <time.h>
#include "inertia.h"
#include "attitude.h"

static double now(void)  /* ns */
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

int main(void)
{
    static inertia_state estimator;
    static attitude_state controller;
    REAL u[3], y[3] = {0}, r[3] = {0}, sum = 0;
    double least[2] = {1e30, 1e30};
    const int samples = 20000;
    inertia_init(&estimator);
    attitude_init(&controller);
    for (int round = 0; round < 20; ++round) {
        double start = now(), middle, end;
        for (int k = 0; k < samples; ++k) {
            for (int j = 0; j < 3; ++j) {
                u[j] = (REAL)((k * 7919 + j * 31) % 101 - 50);
                y[j] += (REAL)1e-3 * u[j];
            }
            inertia_update(&estimator, u, y);
        }
        middle = now();
        for (int k = 0; k < samples; ++k) {
            for (int j = 0; j < 3; ++j) y[j] = (REAL)((k * 7919 + j * 31) % 101 - 50);
            attitude_step(&controller, r, 0, 0, y, u);
            sum += u[0];
        }
        end = now();
        if (middle - start < least[0]) least[0] = middle - start;
        if (end - middle < least[1]) least[1] = end - middle;
    }
    printf("update %.0f ns, LADRC step %.0f ns (%g)\\n", least[0] / samples, least[1] / samples,
           (double)(sum + estimator.inertia[0]));
    return 0;
}
"""


def measure(precision: Literal["double", "float"]) -> str:
    """The least of 20 rounds, compiled by gcc -O2."""
    same = np.ones(AXES)
    estimator = FourierInertia(2 * same, same, 1 + 0.5 * np.arange(TONES), dt=DT)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_c_header(folder / "inertia.h", estimator, name="inertia", precision=precision)
        law = LADRC(4 * same, 25 * same, 0.9 * same, limit=3 * same, dt=DT)
        write_c_header(folder / "attitude.h", law, name="attitude", precision=precision)
        (folder / "main.c").write_text(_PROGRAM.replace("REAL", precision))
        command = ["gcc", "-std=gnu99", "-O2", "main.c", "-o", "main", "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        return subprocess.run([folder / "main"], capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    jq.enable_x64()
    print(f"double: {measure('double')}\nfloat: {measure('float')}")
