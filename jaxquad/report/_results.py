import json
import math
import os
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxquad.identify import Fit, NotIdentifiable, Verification
from jaxquad.spectra import FrequencyResponse


def write_results(
    folder: str | Path,
    *,
    fit: Fit | NotIdentifiable,
    frf: FrequencyResponse | None = None,
    check: Verification | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Write `result.json` into `folder`, whole or not at all; returns its path.

    Numbers that the record does not determine are null: JSON has no nan. Where nothing was, the
    exception may stand for the fit. Raises TypeError for an `extra` that JSON cannot hold.
    """
    content: dict[str, Any] = {"jaxquad_version": _version(), "fit": _fit(fit)}
    content |= {"response": _response(frf)} if frf is not None else {}
    content |= {"verification": verification_content(check)} if check is not None else {}
    content |= dict(extra or {})
    text = json.dumps(plain_content(content), indent=2, allow_nan=False) + "\n"
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    draft = folder / f"result.json.{os.getpid()}.part"
    draft.write_text(text)
    return draft.replace(folder / "result.json")


def _version() -> str | None:
    try:
        return version("jaxquad")
    except PackageNotFoundError:
        return None


def _fit(fit: Fit | NotIdentifiable) -> dict[str, Any]:
    if isinstance(fit, NotIdentifiable):
        return {"identifiable": False, "remarks": [str(fit)]}
    numbers = ("cost", "average_cost", "chi_squared", "condition", "newton_decrement")
    return {
        "identifiable": fit.identifiable,
        "parameters": [_parameter(fit, k) for k in range(len(fit.names))],
        "combinations": [
            combination._asdict() | {"interval_95": combination.interval}
            for combination in fit.combinations
        ],
        "null_directions": fit.null_directions,
        "covariance": fit.covariance,
        **{name: getattr(fit, name) for name in (*numbers, "points", "steps")},
        "remarks": fit.remarks,
    }


def _parameter(fit: Fit, k: int) -> dict[str, Any]:
    return {
        "name": fit.names[k],
        "value": fit.values[k],
        "standard_error": fit.standard_errors[k],
        "interval_95": fit.interval(fit.names[k]),
        "cramer_rao_percent": fit.cramer_rao[k],
        "insensitivity_percent": fit.insensitivity[k],
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


def verification_content(check: Verification) -> dict[str, Any]:
    measures = ("rms", "tic", "fit_percent", "variance_percent")
    names = (*measures, "shift", "bias", "initial")
    return {name: getattr(check, name) for name in names} | {
        "band_rad_per_s": check.band,
        "output": check.output_name,
        "unit": check.output_unit,
        "outputs": [
            {name: getattr(one, name) for name in ("name", "unit", *measures)}
            for one in check.outputs
        ],
    }


def plain_content(value: Any) -> Any:
    """JSON's own types, with null for what is not finite."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain_content(np.asarray(value).tolist())
    if isinstance(value, Mapping):
        return {str(key): plain_content(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_content(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def write_json(path: str | Path, content: Mapping[str, Any]) -> Path:
    """Write `content`, arrays included, to `path`, whole or not at all; returns the path.

    Numbers that are not finite are null: JSON has no nan. Folders are made as needed. Raises
    TypeError for what JSON cannot hold.
    """
    path = Path(path)
    text = json.dumps(plain_content(content), indent=2, allow_nan=False) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    draft.write_text(text)
    return draft.replace(path)
