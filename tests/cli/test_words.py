"""Messages of the library, said in options where the command line shows them."""

import pickle
import re

import numpy as np
import pytest
from package_messages import messages

import jaxquad as jq
from jaxquad._core import Message
from jaxquad.cli import main
from jaxquad.workflows import in_options


SEEN = re.compile(r"jaxquad/(records|spectra|identify|workflows)/")  # rooms below `identify`
ARGUMENTS = (
    "inputs", "outputs", "references", "sample_rate", "units", "time", "time_unit", "dt", "hold",
    "valid", "max_gap", "start", "stop", "window_length", "cost", "window", "integrators",
)  # fmt: skip


@pytest.fixture
def log(tmp_path):
    """No time, a hole in y, one channel that never changes."""
    u = np.sin(np.arange(400) / 7)
    np.savez(tmp_path / "log.npz", u=u, y=np.where(np.arange(400) == 40, np.nan, u), flat=0 * u)
    return tmp_path / "log.npz"


def python_says(log, **options):
    with pytest.raises(ValueError) as error:
        jq.read(log, inputs="u", **options)
    return str(error.value)


@pytest.mark.parametrize(
    ("words", "options", "python", "option"),
    [
        ([], {}, "(dt=)", "(--dt)"),
        ([], {}, "(time=SECONDS+NANOSECONDS)", "(--time SECONDS+NANOSECONDS)"),
        (["--dt", "0.01"], {"dt": 0.01}, "(start=, stop=)", "(--start, --stop)"),
        (["--dt", "0.01"], {"dt": 0.01}, "interpolated (max_gap=)", "interpolated (--max-gap)"),
    ],
)
def test_advice_names_the_option_that_was_typed_for_the_argument(
    log, capsys, words, options, python, option
):
    assert python in python_says(log, outputs="y", **options)
    assert main(["identify", str(log), "--input", "u", "--output", "y", *words]) == 2
    said = capsys.readouterr().err
    assert option in said and python not in said and "jq." not in said


@pytest.mark.slow
def test_an_argument_that_has_an_option_is_said_as_the_option():
    texts = [in_options(text) for place, text in messages() if SEEN.match(place)]
    argument = re.compile(rf"\b({'|'.join(ARGUMENTS)})=(?=[\s),;.:{{]|$)")
    assert len(texts) > 300 and not [text for text in texts if argument.search(text)]


@pytest.mark.parametrize(
    ("python", "options"),
    [
        ("read them with the same sample rate («sample_rate=»)", "(--rate)"),
        ("fit the part of the band where it holds («band=»)", "(--band-rad)"),
        ("give «hold=» in s, 0 for a quantity« (jq.Record, jq.read)»", "give --hold in s, 0 for"),
        ("use a longer window («window_length=»)«, or give the frequencies (omega=)»",
         "(--window)"),
        ("Use «jq.spectra.LocalPolynomial()», or «integrators=» where", "--integrators where"),
        ("check the model by «jq.verify» on another record", "by jaxquad verify on"),
        ("excite the axis («jq.sweep»)", "(jaxquad design sweep)"),
        ("a model that explains more («Fit.explain()» names terms)", "(--explain names terms)"),
        ("`band` (Hz) and `band_rad` (rad/s)", "--band (Hz) and --band-rad (rad/s)"),
        ("lag ran to zero: leave it out«sign|, or let it change with jq.identify.Real('lag')»",
         "leave it out (--no-lag, --no-delay)"),
    ],
)  # fmt: skip
def test_common_advice_in_options(python, options):
    said = in_options(python)
    assert options in said and "jq." not in said


def test_what_is_no_argument_stays():
    text = "gain = 3.1, q=rad/s, F[1][1]=2 and a stick=up; `unknown` stays, max_gap= too"
    assert in_options(text) == text


def test_a_message_prints_in_the_words_of_python_and_keeps_its_kind():
    message = Message("let gaps be interpolated («max_gap=»)", "gap")
    assert message == "let gaps be interpolated (max_gap=)" and message.kind == "gap"
    error = ValueError(pickle.loads(pickle.dumps(message)))
    said = in_options(error.args[0])
    assert said == in_options(error) == "let gaps be interpolated (--max-gap)"
    assert said.kind == "gap"


def test_every_word_of_python_that_a_message_marks_has_one_of_the_command_line():
    texts = [text.replace("»", "«").split("«")[1::2] for _, text in messages()]
    words = {word for text in texts for word in text} - {"plant|X"}  # which a page leaves out
    assert len(words) > 30
    assert not [word for word in words if in_options(f"«{word}»") == Message(f"«{word}»")]
