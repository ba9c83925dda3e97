"""The parameters of a fit, their correlation, and what of them the record determines."""

from collections.abc import Sequence

import numpy as np

from jaxquad.identify import Combination, factors, Fit, NotIdentifiable
from jaxquad.models import TransferFunction

from ._html_text import element, given, Html, joined, scrolling, section, table


_BOUNDS = (20.0, 10.0)  # %, of Cramer-Rao bound and insensitivity (Tischler & Remple, sec. 11.1)
_CORRELATED = 0.9
_DASH = "\u2013"
_REMEDY = (
    "To resolve it: fix one of them at a measured value (leave it out of free=); or give what a "
    "data sheet or a static test says of it as a jq.identify.Prior; or fit a second record under a known "
    "change of it (conditions=)."
)


def parameter_section(fit: Fit, derived: Sequence[Combination]) -> Html:
    heads = ("parameter", "value", "std. error", "95 % interval", "CR, %", "insensitivity, %")
    note = (
        "Standard errors and intervals are calibrated by the measured noise; the Cram\u00e9r-Rao "
        f"bound (CR) and the insensitivity are CIFER's, to be at most {_BOUNDS[0]:g} % and "
        f"{_BOUNDS[1]:g} %; numbers beyond that are bold."
    )
    rows = [_parameter(fit, k) for k in range(len(fit.names))]
    rows += [_combination(each) for each in derived]
    return section(
        "parameters",
        "Parameters",
        table(heads, rows, title="Identified parameters"),
        element("p", note, css="soft"),
        _factored(fit),
        _quality(fit),
        _correlation(fit),
        _printed(fit),
    )


def _parameter(fit: Fit, k: int) -> list[str]:
    name = fit.names[k]
    if name in fit.identifiability.undetermined:
        return [given(name), "not determined", _DASH, _DASH, _DASH, _DASH]
    percents = (fit.cramer_rao[k], fit.insensitivity[k])
    cells = [_marked(f"{x:.2f}", bool(x > most)) for x, most in zip(percents, _BOUNDS, strict=True)]
    return [*_estimate(name, fit.values[k], fit.standard_errors[k], fit.interval(name)), *cells]


def _combination(one: Combination) -> list[str]:
    return [*_estimate(one.name, one.value, one.standard_error, one.interval), _DASH, _DASH]


def _estimate(
    name: str, value: float, error: float, interval: tuple[float, float]
) -> tuple[str, ...]:
    low, high = interval
    return given(name), f"{value:.5g}", f"{error:.2g}", f"{low:.5g} .. {high:.5g}"


def _marked(text: str, beyond: bool) -> str:
    return element("b", text, css="high") if beyond else text


def _factored(fit: Fit) -> Html:
    """Poles and zeros, where the model has them."""
    if not isinstance(fit.model, TransferFunction):
        return Html("")
    try:
        text = str(factors(fit))
    except NotIdentifiable as error:
        text = str(error)
    pre = element("pre", text)
    return joined(element("h3", "Gain, zeros and poles"), scrolling(pre, "Gain, zeros and poles"))


def _quality(fit: Fit) -> Html:
    condition = f"{fit.condition:.3g}" if fit.condition < 1e6 else "singular"
    facts = {
        "misfit / random error": f"{np.sqrt(fit.chi_squared):.2f} (1 if the model explains all)",
        "cost": f"{fit.cost:.4g}, on average {fit.average_cost:.4g} for each response",
        "points": f"{fit.points} frequencies",
        "condition of the Jacobian": condition,
        "solver": f"{fit.steps} steps, Newton decrement {fit.newton_decrement:.1e}",
    }
    if fit.minima:
        starts = sum(len(point.starts) for point in fit.minima)
        facts["starts"] = f"{starts}, which led to {len(fit.minima)} points"
    return definitions(facts)


def definitions(facts: dict[str, str]) -> Html:
    pairs = [(element("dt", name), element("dd", text)) for name, text in facts.items()]
    return element("dl", *(part for pair in pairs for part in pair))


def _correlation(fit: Fit) -> Html:
    known = [k for k, n in enumerate(fit.names) if n not in fit.identifiability.undetermined]
    if len(known) < 2:
        return Html("")
    matrix = fit.correlation
    rows = [
        [given(fit.names[k]), *(_correlated(matrix[k, m], k == m) for m in known)] for k in known
    ]
    return table(
        ["", *(given(fit.names[k]) for k in known)],
        rows,
        title=f"Correlation of the estimates (bold from {_CORRELATED:g})",
    )


def _correlated(value: float, same: bool) -> str:
    return "1" if same else _marked(f"{value:.2f}", bool(abs(value) >= _CORRELATED))


def _printed(fit: Fit) -> Html:
    text = element("pre", str(fit))
    return element("details", element("summary", "As printed"), scrolling(text, "The fit as text"))


def identifiability_section(fit: Fit | NotIdentifiable) -> Html:
    title = "Identifiability"
    if isinstance(fit, NotIdentifiable):
        return section("identifiability", title, element("p", str(fit)))
    if fit.identifiable:
        return section("identifiability", title, element("p", _sharpness(fit)))
    lost = [given(name) for name in fit.identifiability.undetermined]
    return section(
        "identifiability",
        title,
        element("p", "This record does not determine, each by itself: ", _listed(lost), "."),
        _determined(fit),
        _directions(fit),
        element("p", _REMEDY),
    )


def _listed(names: Sequence[Html]) -> Html:
    return joined(*(part for k, name in enumerate(names) for part in (", " * (k > 0), name)))


def _sharpness(fit: Fit) -> str:
    text = "Every free parameter is determined by itself."
    known = [k for k, value in enumerate(fit.values) if value != 0]
    if not known:
        return text
    share, k = max((float(abs(fit.standard_errors[k] / fit.values[k])), k) for k in known)
    least = f"The least sharp is {fit.names[k]}, with a standard error of {100 * share:.2g} %"
    return f"{text} {least} of its value."


def _determined(fit: Fit) -> Html:
    if not fit.combinations:
        return element("p", "Nothing that combines them is determined either.")
    rows = [_combination(each)[:4] for each in fit.combinations]
    heads = ("combination", "value", "std. error", "95 % interval")
    return table(heads, rows, title="What is determined of them")


def _directions(fit: Fit) -> Html:
    if not fit.null_directions:
        return Html("")
    names = list(dict.fromkeys(name for each in fit.null_directions for name in each))
    rows = [
        [f"direction {k + 1}", *(f"{each[n]:+.3f}" if n in each else _DASH for n in names)]
        for k, each in enumerate(fit.null_directions)
    ]
    title = "Null directions: relative changes that leave the responses as they are"
    return table(["", *map(given, names)], rows, title=title)
