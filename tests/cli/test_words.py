"""Messages of the library, said in options where the command line shows them."""

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.cli import main


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
