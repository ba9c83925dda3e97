"""What a figure shows: models, fits, loops, measured responses and records, by name."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, PyTree

from jaxquad.identify import as_sampled, Fit, linear_model, model_response
from jaxquad.models import Model
from jaxquad.records import Record
from jaxquad.spectra import frequency_response, FrequencyResponse, StepResponse


Thing = PyTree  # model, fit, loop, measured response or record; or several, by name or in a list
_KINDS = (
    "a model with frequency_response(omega), a fit of jq.fit, a jq.Loop, what jq.analyse or "
    "jq.frequency_response returns, or a jq.Record"
)


def named(shown: Iterable[Thing]) -> dict[str, Thing]:
    """All things by name. Those that come without one are called by what they are."""
    flat: list[tuple[str, Thing]] = []
    for thing in shown:
        if isinstance(thing, Mapping):
            flat += [(str(name), part) for name, part in thing.items()]
        else:
            parts = thing if isinstance(thing, list | tuple) else [thing]
            flat += [("", part) for part in parts if part is not None]
    kinds = {"flown": Record | StepResponse, "fit": Fit, "model": Model}
    unnamed = [
        f"{thing.method} estimate"
        if isinstance(thing, FrequencyResponse)
        else next((kind for kind, types in kinds.items() if isinstance(thing, types)), "loop")
        for name, thing in flat
        if not name
    ]
    things, places = {}, iter(range(len(unnamed)))
    for name, thing in flat:
        if not name:
            k = next(places)
            name, count = unnamed[k], unnamed[: k + 1].count(unnamed[k])
            name = name if unnamed.count(name) == 1 else f"{name} {count}"
        things[name] = thing
    return things


def named_models(shown: Iterable[Thing] | Mapping[str, Thing], what: str) -> dict[str, Thing]:
    """Models, fits and loops by name, for `what` draws them, which was not measured."""
    things = dict(shown) if isinstance(shown, Mapping) else named(shown)
    if not things:
        raise ValueError(f"{what} has nothing to draw: give a model, a fit of jq.fit or a jq.Loop")
    for name, thing in things.items():
        if isinstance(thing, FrequencyResponse | Record):
            raise ValueError(
                f"{name} was measured, but {what} needs a model: fit one to it with jq.fit, and "
                "give the fit"
            )
    return things


class Measured(NamedTuple):
    """A measured response, and which of its points a fit has used, if that is known."""

    name: str
    frf: FrequencyResponse
    used: Bool[np.ndarray, "frequencies outputs inputs"] | None = None


class Modelled(NamedTuple):
    """A model; a fit's has a band."""

    name: str
    model: Model
    fit: Fit | None = None


def analysed(name: str, thing: Thing, what: str) -> PyTree:
    """The `LoopAnalysis` of a loop's first axis, or the one that is given.

    Raises ValueError for what is no loop, and for an ensemble of loops.
    """
    from jaxquad.loops import analyse, Loop, LoopAnalysis  # here: most figures show no loop

    analysis = analyse(thing, 0) if isinstance(thing, Loop) else thing
    if not isinstance(analysis, LoopAnalysis):
        raise ValueError(f"{what} cannot draw a {type(thing).__name__}: give {_KINDS}")
    if analysis.abscissa.ndim:
        raise ValueError(
            f"{name} is an ensemble of {analysis.abscissa.size} loops: give one of them to {what}, "
            "jq.analyse(loop, member=0)"
        )
    return analysis


class Channels(NamedTuple):
    """Names and units of outputs and inputs; empty where nobody said."""

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    output_units: tuple[str, ...]
    input_units: tuple[str, ...]
    are_named: bool  # by a record

    @classmethod
    def numbered(cls, outputs: int, inputs: int) -> "Channels":
        """`y1`, `y2`, `u1`: where nobody has named them."""
        count = lambda letter, n: tuple(f"{letter}{k + 1}" for k in range(n))
        units = ("",) * outputs, ("",) * inputs
        return cls(count("y", outputs), count("u", inputs), *units, False)

    def places(self, pair: tuple[str, str] | None) -> list[tuple[int, int]]:
        """Outputs and inputs that are drawn, row by row. Raises ValueError for unknown names."""
        if pair is None:
            return [(o, i) for o in range(len(self.outputs)) for i in range(len(self.inputs))]
        output, source = pair
        if output not in self.outputs or source not in self.inputs:
            raise ValueError(
                f"no response {pair}: outputs are {self.outputs}, inputs {self.inputs}"
            )
        return [(self.outputs.index(output), self.inputs.index(source))]

    def ratio(self, o: int, i: int) -> str:
        """`q / M`; nothing for a single pair without names."""
        if not self.are_named and len(self.outputs) == len(self.inputs) == 1:
            return ""
        return f"{self.outputs[o]} / {self.inputs[i]}"

    def unit(self, o: int, i: int) -> str:
        """`rad/s per V`; nothing where a unit is unknown."""
        output, source = self.output_units[o], self.input_units[i]
        return f"{output} per {source}" if output and source else ""


_DECADES = (-1.0, 2.0)  # of rad/s, for models that do not say where they change
_POINTS = 300


class Shown(NamedTuple):
    """Responses, what is measured before what is a model."""

    measured: list[Measured]
    modelled: list[Modelled]

    @classmethod
    def of(cls, shown: Iterable[Thing], what: str) -> "Shown":
        """Of all things, for `what` draws them. Raises ValueError for those without a response.

        The response that a fit was made from belongs to it, unless other ones are given.
        """
        things = named(shown)
        if not things:
            raise ValueError(f"{what} has nothing to draw: give {_KINDS}")
        measured, modelled, fits = [], [], []
        for name, thing in things.items():
            if isinstance(thing, FrequencyResponse | Record):
                frf = frequency_response(thing) if isinstance(thing, Record) else thing
                measured.append(Measured(name, frf))
            elif isinstance(thing, Fit):
                fits.append(thing)
                modelled += [Modelled(name, thing.model, thing)] if thing.verdict.fitted else []
            else:
                model = thing if isinstance(thing, Model) else analysed(name, thing, what).loop
                modelled.append(Modelled(name, model))
        origins = [fit.origin for fit in fits if fit.origin is not None]
        for points in (points for origin in origins for points in origin.points):
            if not measured:
                measured = [Measured(f"{points.frf.method} estimate", points.frf)]
            measured = [
                x._replace(used=points.used) if x.frf is points.frf and x.used is None else x
                for x in measured
            ]
        return cls(measured, modelled)

    def frequencies(
        self, omega: Float[ArrayLike, " frequencies"] | None
    ) -> Float[np.ndarray, " frequencies"]:
        """Where models are drawn, in rad/s: as given, over what was measured, or about poles."""
        if omega is not None:
            return np.atleast_1d(np.asarray(omega, float))
        spans = [np.asarray(response.frf.omega)[[0, -1]] for response in self.measured]
        for model in () if spans else (entry.model for entry in self.modelled):
            if (dt := getattr(model, "dt", None)) is not None:  # it ends at pi / dt
                spans.append(np.array([1e-3, 0.999]) * (np.pi / dt))
                continue
            try:
                plant = linear_model(model)
                sizes = np.abs(np.concatenate([plant.poles, plant.zeros]))
                sizes = sizes[(sizes > 1e-6) & np.isfinite(sizes)]
            except ValueError:
                sizes = np.empty(0)
            low, high = _DECADES
            if sizes.size:
                low = np.floor(np.log10(sizes.min()) - 1 + 0.3)
                high = np.ceil(np.log10(sizes.max()) + 1 - 0.3)
            spans.append(np.array([10.0**low, 10.0**high]))
        return np.geomspace(min(x[0] for x in spans), max(x[1] for x in spans), _POINTS)

    def response(self, model: Model, omega: Float[np.ndarray, " frequencies"]) -> np.ndarray:
        """A model's; where one was measured, as the samples of that record show it."""
        return model_response(
            as_sampled(model, self.measured[0].frf) if self.measured else model, omega
        )

    @property
    def channels(self) -> Channels:
        """Those of the measured response, else of the first model, by number."""
        if self.measured:
            frf = self.measured[0].frf
            units = frf.output_units or ("",) * len(frf.output_names)
            sources = frf.input_units or ("",) * len(frf.input_names)
            return Channels(frf.output_names, frf.input_names, units, sources, True)
        one = np.ones(1)
        shapes = {x.name: model_response(x.model, one).shape[1:] for x in self.modelled}
        if len(set(shapes.values())) > 1:
            raise ValueError(
                f"models of different channels (outputs, inputs): {shapes}; draw them one by one"
            )
        return Channels.numbered(*next(iter(shapes.values())))
