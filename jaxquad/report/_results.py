import json
import math
import os
import tempfile
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from jaxquad.identify import Fit, Verification
from jaxquad.spectra import FrequencyResponse


def write_results(
    folder: str | Path,
    *,
    fit: Fit,
    frf: FrequencyResponse | None = None,
    check: Verification | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Write `result.json` into `folder`, whole or not at all; returns its path.

    Numbers that the record does not determine are null: JSON has no nan.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    content = {"jaxquad": _version(), "fit": _fit(fit)}
    content |= {"response": _response(frf)} if frf is not None else {}
    content |= {"verification": _verification(check)} if check is not None else {}
    content |= dict(extra or {})
    text = json.dumps(_plain(content), indent=2, allow_nan=False) + "\n"
    handle, draft = tempfile.mkstemp(dir=folder, suffix=".json.part")
    with os.fdopen(handle, "w") as file:
        file.write(text)
    os.chmod(draft, 0o644)
    os.replace(draft, folder / "result.json")
    return folder / "result.json"


def _version() -> str:
    try:
        return version("jaxquad")
    except PackageNotFoundError:
        return "not installed"


def _fit(fit: Fit) -> dict[str, Any]:
    parameters = [
        {
            "name": name,
            "value": fit.values[k],
            "standard_error": fit.standard_errors[k],
            "interval_95": fit.interval(name),
            "cramer_rao_percent": fit.cramer_rao[k],
            "insensitivity_percent": fit.insensitivity[k],
        }
        for k, name in enumerate(fit.names)
    ]
    numbers = ("cost", "average_cost", "chi_squared", "newton_decrement", "condition", "points")
    return {
        "identifiable": fit.identifiable,
        "parameters": parameters,
        "combinations": [combination._asdict() for combination in fit.combinations],
        "null_directions": list(fit.null_directions),
        "covariance": fit.covariance,
        **{name: getattr(fit, name) for name in (*numbers, "steps")},
        "remarks": fit.remarks,
    }


def _response(frf: FrequencyResponse) -> dict[str, Any]:
    return {
        "method": frf.method,
        "inputs": frf.input_names,
        "outputs": frf.output_names,
        "omega_rad_per_s": frf.omega,
        "magnitude_db": frf.magnitude_db,
        "phase_deg": frf.phase_deg,
        "coherence": frf.coherence,
        "random_error": frf.random_error,
        "remarks": frf.remarks,
    }


def _verification(check: Verification) -> dict[str, Any]:
    names = ("rms", "tic", "fit_percent", "variance_percent", "shift", "bias")
    return {name: getattr(check, name) for name in names} | {
        "band_rad_per_s": check.band,
        "output": check.output_name,
        "unit": check.output_unit,
    }


def _plain(value: Any) -> Any:
    """JSON's own types, with null for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return _plain(np.asarray(value).tolist())
