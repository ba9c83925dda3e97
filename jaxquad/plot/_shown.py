"""What a figure shows: models, fits, loops, measured responses and records, by name."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree

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
    for each in shown:
        if isinstance(each, Mapping):
            flat += [(str(name), thing) for name, thing in each.items()]
        else:
            parts = each if isinstance(each, list | tuple) else [each]
            flat += [("", thing) for thing in parts if thing is not None]
    bases = [name or _kind(thing) for name, thing in flat]
    return {_distinct(k, flat, bases): thing for k, (_, thing) in enumerate(flat)}


def named_models(shown: Iterable[Thing] | Mapping[str, Thing], what: str) -> dict[str, Thing]:
    """Models, fits and loops by name, for `what` draws them.

    Raises ValueError for nothing, and for what was measured.
    """
    things = dict(shown) if isinstance(shown, Mapping) else named(shown)
    if not things:
        raise ValueError(f"{what} has nothing to draw: give a model, a fit of jq.fit or a jq.Loop")
    for name, thing in things.items():
        if _is_measured(thing):
            raise ValueError(
                f"{name} was measured, but {what} needs a model: fit one to it with jq.fit, and "
                "give the fit"
            )
    return things


def _distinct(k: int, flat: list[tuple[str, Thing]], bases: list[str]) -> str:
    unnamed = [bases[m] for m, (name, _) in enumerate(flat) if not name]
    if flat[k][0] or unnamed.count(bases[k]) == 1:
        return bases[k]
    place = sum(bases[m] == bases[k] and not flat[m][0] for m in range(k + 1))
    return f"{bases[k]} {place}"


def _kind(thing: Thing) -> str:
    if isinstance(thing, FrequencyResponse):
        return f"{thing.method} estimate"
    kinds = {"flown": Record | StepResponse, "fit": Fit, "model": Model}
    return next((name for name, kind in kinds.items() if isinstance(thing, kind)), "loop")


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


def measured_and_modelled(
    shown: Iterable[Thing], what: str
) -> tuple[list[Measured], list[Modelled]]:
    """What is measured and what is a model among all things; `what` draws them.

    The response that a fit was made from belongs to it, unless other ones are given. Raises
    ValueError for nothing, and for things that have no frequency response.
    """
    things = named(shown)
    if not things:
        raise ValueError(f"{what} has nothing to draw: give {_KINDS}")
    measured = [Measured(name, _measured(x)) for name, x in things.items() if _is_measured(x)]
    rest = {name: x for name, x in things.items() if not _is_measured(x)}
    modelled = [each for name, x in rest.items() for each in _modelled(name, x, what)]
    fits = [x for x in rest.values() if isinstance(x, Fit) and x.origin is not None]
    for points in (points for fit in fits for points in _points(fit)):
        if not measured:
            measured = [Measured(f"{points.frf.method} estimate", points.frf)]
        mine = [each.frf is points.frf and each.used is None for each in measured]
        measured = [
            each._replace(used=points.used) if own else each
            for each, own in zip(measured, mine, strict=True)
        ]
    return measured, modelled


def _points(fit: Fit):
    return () if fit.origin is None else fit.origin.points


def _is_measured(thing: Thing) -> bool:
    return isinstance(thing, FrequencyResponse | Record)


def _measured(thing: FrequencyResponse | Record) -> FrequencyResponse:
    return frequency_response(thing) if isinstance(thing, Record) else thing


def _modelled(name: str, thing: Thing, what: str) -> list[Modelled]:
    if isinstance(thing, Fit):
        return [Modelled(name, thing.model, thing)] if thing.verdict.fitted else []
    model = thing if isinstance(thing, Model) else _broken_loop(name, thing, what)
    return [Modelled(name, model)]


def analysed(name: str, thing: Thing, what: str) -> PyTree:
    """The `LoopAnalysis` of a loop's first axis, or the one that is given.

    Raises ValueError for what is no loop, and for an ensemble of loops.
    """
    from jaxquad.loops import analyse, Loop, LoopAnalysis  # here: most figures show no loop

    found = analyse(thing, 0) if isinstance(thing, Loop) else thing
    if not isinstance(found, LoopAnalysis):
        raise ValueError(f"{what} cannot draw a {type(thing).__name__}: give {_KINDS}")
    if found.abscissa.ndim:
        raise ValueError(
            f"{name} is an ensemble of {found.abscissa.size} loops: give one of them to {what}, "
            "jq.analyse(loop, member=0)"
        )
    return found


def _broken_loop(name: str, thing: Thing, what: str) -> Model:
    return analysed(name, thing, what).loop


@runtime_checkable
class _IsSampled(Protocol):
    """A response that ends at pi / dt."""

    dt: float


_DECADES = (-1.0, 2.0)  # of rad/s, for models that do not say where they change
_POINTS = 300


def frequencies_of(
    measured: list[Measured],
    modelled: list[Modelled],
    omega: Float[np.ndarray, "..."] | None,
) -> Float[np.ndarray, " frequencies"]:
    """Where models are drawn, in rad/s: as given, over what was measured, or about their poles."""
    if omega is not None:
        return np.atleast_1d(omega)
    spans = [np.asarray(each.frf.omega)[[0, -1]] for each in measured]
    spans = spans or [_span(each.model) for each in modelled]
    return np.geomspace(min(x[0] for x in spans), max(x[1] for x in spans), _POINTS)


def _span(model: Model) -> tuple[float, float]:
    if isinstance(model, _IsSampled):
        end = np.pi / model.dt
        return 1e-3 * end, 0.999 * end
    try:
        plant = linear_model(model)
    except ValueError:
        return 10.0 ** _DECADES[0], 10.0 ** _DECADES[1]
    sizes = np.abs(np.concatenate([plant.poles, plant.zeros]))
    sizes = sizes[(sizes > 1e-6) & np.isfinite(sizes)]
    if not sizes.size:
        return 10.0 ** _DECADES[0], 10.0 ** _DECADES[1]
    low, high = np.log10(sizes.min()) - 1, np.log10(sizes.max()) + 1
    return float(10 ** np.floor(low + 0.3)), float(10 ** np.ceil(high - 0.3))


def response_beside(
    each: Modelled, omega: Float[np.ndarray, " frequencies"], beside: FrequencyResponse | None
) -> np.ndarray:
    """A model's response; beside a measured one as the record's samples show it."""
    model = each.model if beside is None else as_sampled(each.model, beside)
    return model_response(model, omega)


class Channels(NamedTuple):
    """Names and units of outputs and inputs; empty where nobody said."""

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    output_units: tuple[str, ...]
    input_units: tuple[str, ...]
    known: bool  # names come from a record

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
        if not self.known and len(self.outputs) == len(self.inputs) == 1:
            return ""
        return f"{self.outputs[o]} / {self.inputs[i]}"

    def unit(self, o: int, i: int) -> str:
        """`rad/s per V`; nothing where a unit is unknown."""
        return unit_pair(self.output_units[o], self.input_units[i])


def unit_pair(output: str, source: str) -> str:
    """`rad/s per V`; nothing where one of the two is unknown."""
    return f"{output} per {source}" if output and source else ""


def channels_shown(measured: list[Measured], modelled: list[Modelled]) -> Channels:
    """Those of the measured response, else of the first model, by number."""
    if measured:
        frf = measured[0].frf
        units = frf.output_units or ("",) * len(frf.output_names)
        sources = frf.input_units or ("",) * len(frf.input_names)
        return Channels(frf.output_names, frf.input_names, units, sources, True)
    shapes = {each.name: _shape(each) for each in modelled}
    if len(set(shapes.values())) > 1:
        raise ValueError(
            f"models of different channels (outputs, inputs): {shapes}; draw them one by one"
        )
    return Channels.numbered(*next(iter(shapes.values())))


def _shape(each: Modelled) -> tuple[int, int]:
    found = model_response(each.model, np.asarray(jnp.ones(1)))
    return found.shape[1], found.shape[2]
