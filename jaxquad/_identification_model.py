"""An identified model in `result.json`, and back."""

import json
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

from .identify import Fit, NotIdentifiable
from .models import LaggedIntegrator, TransferFunction
from .spectra import FrequencyResponse


Model = LaggedIntegrator | TransferFunction


def model_content(outcome: Fit | NotIdentifiable) -> dict[str, Any]:
    """The model's kind and numbers; nothing where there is none."""
    if isinstance(outcome, NotIdentifiable):
        return {}
    model = outcome.model
    return {
        "model": {"kind": type(model).__name__} | {k: _plain(v) for k, v in vars(model).items()}
    }


def setup_content(options: Namespace, frf: FrequencyResponse) -> dict[str, Any]:
    """What another record needs to be read in the same way, and the band that was fitted."""
    names = ("input", "output", "rate", "time", "time_unit")
    setup = {name: getattr(options, name) for name in names}
    band = [float(frf.omega[0]), float(frf.omega[-1])]
    return {"setup": setup | {"unit": [list(each) for each in options.unit], "band_rad": band}}


def stored(path: Path) -> dict[str, Any]:
    """What `jaxquad identify` left in a folder, or its `result.json` itself.

    Raises ValueError for a file that it did not write.
    """
    path = path / "result.json" if path.is_dir() else path
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such result: run jaxquad identify first") from error
    except ValueError as error:
        raise ValueError(f"{path}: no result of jaxquad identify: {error}") from error
    if not isinstance(content, dict) or not {"fit", "setup", "provenance"} <= set(content):
        raise ValueError(f"{path}: no result of this jaxquad identify: identify the record again")
    return content


def stored_model(content: dict[str, Any]) -> Model:
    """The model of a stored result. Raises NotIdentifiable where there is none."""
    if "model" not in content:
        raise NotIdentifiable(f"the result holds no model: {' '.join(content['fit']['remarks'])}")
    numbers = dict(content["model"])
    kinds = {"LaggedIntegrator": LaggedIntegrator, "TransferFunction": TransferFunction}
    kind = numbers.pop("kind", None)
    if kind not in kinds:
        raise ValueError(f"the result holds a model of kind {kind!r}: none of {', '.join(kinds)}")
    try:
        return kinds[kind](**numbers)
    except TypeError as error:
        raise ValueError(f"the result's model is incomplete: {error}") from error


def _plain(value: Any) -> Any:
    return value if isinstance(value, int) else np.asarray(value).tolist()
