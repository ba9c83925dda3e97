"""`jaxquad identify` as the work of a batch."""

import contextlib
import json
import re
import threading
import warnings
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxquad.records import parse_mix

from ._store import Job, write_whole


_ONE_AT_A_TIME = threading.Lock()  # stdout and matplotlib belong to the process, not to a thread
_DEFAULTS: Mapping[str, Any] = {
    "time": None, "time_unit": None, "input": None, "output": None, "reference": None, "axis": None,
    "unit": (), "rate": None, "start": None, "stop": None, "segment": (),
    "band": None, "band_rad": None, "integrators": 1, "no_lag": False, "no_delay": False,
    "poles": None, "zeros": 0, "estimator": "local", "window": None, "cost": "ml",
    "verify": None, "verify_start": None, "verify_stop": None,
}  # fmt: skip


def identify_log(job: Job) -> dict[str, Any]:
    """Identify one log; its report and figures go to `logs/` in the folder of the batch."""
    import jax
    import matplotlib

    from .._identify import report_identification

    name = re.sub(r"[^\w.-]", "_", Path(job.log).stem)[:60]
    folder = Path(job.out) / "logs" / f"{name}-{job.key[:12]}"
    folder.mkdir(parents=True, exist_ok=True)
    with _ONE_AT_A_TIME, (folder / "printed.txt").open("w", errors="replace") as printed:
        matplotlib.use("Agg")
        jax.config.update("jax_enable_x64", True)
        with contextlib.redirect_stdout(printed), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            path, failure = report_identification(options_of(job, folder))
    content = json.loads(path.read_text())
    said = list(dict.fromkeys(" ".join(str(each.message).split()) for each in caught))
    if said:
        write_whole(folder / "warnings.txt", "\n".join(said).encode("utf-8", "replace"))
    return {
        "status": "identified" if failure is None else "not identifiable",
        "error": "" if failure is None else " ".join(str(failure).split()),
        "parameters": [
            _parameter(row) for row in [*content["fit"].get("parameters", ()), *content["derived"]]
        ],
        "remarks": [*said, *content["fit"]["remarks"]],
        "report": (folder / "report.html").relative_to(job.out).as_posix(),
    }


def options_of(job: Job, folder: Path) -> Namespace:
    """The options of `jaxquad identify` that a job's settings stand for."""
    given = dict(job.settings)
    mixes = {name: parse_mix(given.pop(name)) for name in ("input", "output", "reference")
             if name in given}  # fmt: skip
    units = {"unit": [(name, str(unit)) for name, unit in given.pop("units", {}).items()]}
    segments = {"segment": [tuple(each) for each in given.pop("segments", ())]}
    switches = {f"no_{name}": not given.pop(name) for name in ("lag", "delay") if name in given}
    options = dict(_DEFAULTS) | given | mixes | units | segments | switches
    return Namespace(file=Path(job.log), out=folder, **options)


def _parameter(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in ("name", "value", "standard_error")}
