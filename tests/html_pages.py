"""What reports are made of in tests, and a page taken apart by the standard library's parser."""

import base64
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import jax.numpy as jnp
import numpy as np
from certificates_by_hand import certificate, judged, missed

import jaxquad as jq
from jaxquad.tuning import Evaluation, Tuned, Verdict


ERROR = 0.005
TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)
# What a log may be called: markup, quotes, an override of the reading direction, formulas, halves
# of surrogate pairs (undecodable file names), controls, letters that no font here has.
HOSTILE = (
    "<script>alert(1)</script>",
    "\"><img src=http://evil.example/x onerror=alert(1)>'&amp;&lt;",
    "\u202ecod.exe\u200f \u05d0\u05d1 \u2067x",
    r"$\frac{1}{$ \$x^2$ $$",
    "a\udc80\x00\x07\x1b[31m\r\n--></style></title><b>\ufffe",
    "\u59ff\u6001 \U0001f681 " + "very_long_name." * 40,
)


UNSEEN = "[\x00-\x08\x1b\u202a-\u202e\u2066-\u2069]"
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Elements in their order and texts by element; `errors` is what is not closed."""

    def __init__(self, text: str):
        super().__init__(convert_charrefs=True)
        self.open, self.errors, self.elements = [], [], []
        self.texts: list[tuple[tuple[str, ...], str]] = []
        self.feed(text)
        self.close()
        self.errors += self.open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.errors.append(f"</{tag}> at {self.getpos()}")

    def handle_data(self, data):
        self.texts.append((tuple(self.open), data))

    def of(self, tag):
        """The attributes of every element of a kind."""
        return [attributes for name, attributes in self.elements if name == tag]

    def text(self, *within):
        """All that is shown, or what is shown inside elements of these kinds."""
        skipped = {"style", "title", "script"} - set(within)
        return "".join(
            text
            for path, text in self.texts
            if set(within) <= set(path) and not skipped & set(path)
        )

    def figures(self):
        """Kind and bytes of every figure."""
        for attributes in self.of("img"):
            head, data = attributes["src"].split(";base64,")
            yield head.removeprefix("data:image/"), base64.b64decode(data, validate=True)


def read_page(path):
    return Page(path.read_bytes().decode())


def is_image(kind, data):
    if kind == "svg+xml":
        return ET.fromstring(data).tag.endswith("svg")
    return kind == "png" and data.startswith(b"\x89PNG\r\n")


def record_of(names, units, source="flight.csv"):
    time = np.arange(4000) * 0.01
    u = np.sign(np.sin(3 * time))
    y = np.asarray(jq.models.simulate_linear(TRUTH.transfer_function(), u, 0.01))
    return jq.Record(
        time, u, y, u, input_names=names[0], output_names=names[1], reference_names=names[2],
        input_units=units[0], output_units=units[1], reference_units=units[2], source=source,
    )  # fmt: skip


def flown_by_hand():
    """A flight that follows a step at once."""
    count = 50
    zero = np.zeros((count, 1))
    step = zero + np.radians(4.0)
    flight = jq.simulation.Scenario(*map(jnp.asarray, (step, zero, zero, zero)), dt=0.01)
    time, angle, still = (jnp.asarray(x) for x in (0.01 * np.arange(count), step, zero))
    never = jnp.zeros((count, 1), bool)
    return jq.simulation.Simulation(
        time, angle, angle, still, never, {}, jnp.zeros((), bool), flight, 0.01
    )


def tuned_by_hand():
    """Two gains from two evaluations, and a certificate that fails; nothing was flown."""
    designs = {"tuned": judged(8.0, 2.0), "<peer>": judged(40.0, 50.0, unstable=(2, 7))}
    none = np.full(1, np.nan)
    history = tuple(
        Evaluation("optimise", none[:, None], np.array([cost]), none, np.ones(1), none, {}, 0.0)
        for cost in (2.0, 1.0)
    )
    return Tuned(
        controller=TRUTH,
        certificate=certificate(designs, [missed("sensitivity_peak", 1.5, 2.0)]),
        stabilised=True, converged=True, cost=1.0, values={"ladrc.wc": 5.25, "ladrc.wo": 40.0},
        limits=(), minima=(), bounds=(), convergence=Verdict("CONVERGENCE", True, "2 gradients"),
        evaluations=2, stabilising=0, history=history, seconds=1.0,
        remarks=("a remark of the tuner",),
    )  # fmt: skip
