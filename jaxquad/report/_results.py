import json
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from jaxquad._core import plain_content, write_file
from jaxquad.identify import Agreement, Fit, Verification
from jaxquad.spectra import FrequencyResponse


Json = Mapping[str, object]


def write_json(path: str | Path, content: Json) -> Path:
    """Write a JSON file, whole or not at all.

    **Arguments:**

    - `path`: its folders are made as needed.
    - `content`: arrays included; numbers that are not finite become null.

    **Returns:** the path.

    **Raises:** TypeError for what JSON cannot hold.
    """
    return write_file(path, json.dumps(plain_content(content), indent=2, allow_nan=False) + "\n")


def write_results(
    folder: str | Path,
    *,
    fit: Fit,
    frf: FrequencyResponse | None = None,
    check: Verification | None = None,
    extra: Json | None = None,
) -> Path:
    """Write `result.json` into a folder, whole or not at all.

    Numbers that are not finite are null: JSON has no nan. Parameters that the record does not
    determine keep their numbers, beside `"determined": false`; where nothing could be fitted there
    are none.

    **Arguments:**

    - `folder`: is made as needed.
    - `fit`, `frf`, `check`: the fit, the response that was fitted, the model simulated on a record.
    - `extra`: further keys.

    **Returns:** the path of the file.

    **Raises:** TypeError for an `extra` that JSON cannot hold.
    """
    try:
        jaxquad_version = version("jaxquad")
    except PackageNotFoundError:
        jaxquad_version = None
    content: dict[str, object] = {"jaxquad_version": jaxquad_version, "fit": fit.to_dict()}
    if frf is not None:
        content["response"] = {
            "method": frf.method,
            "inputs": frf.input_names,
            "outputs": frf.output_names,
            "input_units": frf.input_units,
            "output_units": frf.output_units,
            "omega_rad_per_s": frf.omega,
            "magnitude_db": frf.magnitude_db,
            "phase_deg": frf.phase_deg,
            "coherence": frf.coherence,
            "random_error": frf.random_error,
            "remarks": tuple(frf.remarks),
        }
    content |= {"verification": verification_content(check)} if check is not None else {}
    content |= dict(extra or {})
    return write_json(Path(folder) / "result.json", content)


def verification_content(check: Verification) -> dict[str, object]:
    """The measures of a verification, for JSON."""
    return {
        **_measures(check),
        "shift": check.shift,
        "bias": check.bias,
        "initial": check.initial,
        "band_rad_per_s": check.band,
        "output": check.output_name,
        "unit": check.output_unit,
        "outputs": [{"name": o.name, "unit": o.unit, **_measures(o)} for o in check.outputs],
    }


def _measures(agreement: Verification | Agreement) -> dict[str, object]:
    return {
        "rms": agreement.rms,
        "tic": agreement.tic,
        "fit_percent": agreement.fit_percent,
        "variance_percent": agreement.variance_percent,
    }
