"""Scripts share work with a second process, which is set up as theirs is."""

import os

import jax
import pytest

import jaxquad as jq
from jaxquad import _compile
from jaxquad._core import _beside, behind, beside, has_second_process


pytestmark = pytest.mark.usefixtures("allowed")


@pytest.fixture
def allowed(monkeypatch):
    monkeypatch.delenv("JAXQUAD_SECOND_PROCESS")
    monkeypatch.setattr(_beside, "available_cores", lambda: 2)


def settings():
    """Of the process that calls it."""
    values = jax.config.values
    return os.getpid(), values["jax_enable_x64"], values["jax_compilation_cache_dir"]


def there(function):
    """What it finds in the other process, which this one leaves to it."""
    later = beside(function)
    assert _beside._second is not None
    while later.answer is None:
        with _beside._second._changed:
            _beside._second._changed.wait(0.1)
    return later.get()


def test_it_computes_in_64_bits_and_ends_with_the_block(monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    with jq.second_process():
        process, bits, folder = there(settings)
    assert process != os.getpid() and bits and not folder
    assert not has_second_process() and beside(os.getpid).get() == os.getpid()


def test_it_keeps_compiled_programs_where_the_script_does(monkeypatch, tmp_path):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("JAXQUAD_CACHE", str(tmp_path))
    monkeypatch.setattr(_compile, "own_folder", lambda: tmp_path)
    with jq.second_process():
        _, _, folder = there(settings)
        assert str(folder).startswith(str(tmp_path / "process-"))


def test_an_error_ends_it_and_a_block_within_another_does_not():
    with pytest.raises(KeyError), jq.second_process():
        with jq.second_process():
            assert has_second_process()
        assert has_second_process() and behind(os.getpid).get()
        raise KeyError
    assert not has_second_process()
