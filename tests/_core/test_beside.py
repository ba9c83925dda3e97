"""A second process computes what this one would have, and its end loses nothing."""

import os
import time
import warnings

import numpy as np
import pytest

from jaxquad._core import (
    _beside,
    allowed_second_process,
    behind,
    beside,
    has_second_process,
    Later,
    prepare_second_process,
    start_second_process,
)
from jaxquad.spectra import begin_remarks
from jaxquad.spectra._remarks import Remarks


@pytest.fixture
def second(monkeypatch):
    monkeypatch.delenv("JAXQUAD_SECOND_PROCESS")
    monkeypatch.setattr(_beside, "available_cores", lambda: 2)
    with allowed_second_process():
        start_second_process()
        assert _beside._second is not None
        yield _beside._second


def begun(function, *args):
    """`beside`, once the other process has begun with it: from there on nobody else may."""
    later = beside(function, *args)
    assert _beside._second is not None
    while later in _beside._second._waiting:
        time.sleep(0.01)
    return later


def end_elsewhere(here):
    """Where it is called."""
    if os.getpid() != here:
        os._exit(3)
    return os.getpid()


def scale(values, by):
    return by * values


def test_calls_are_made_in_another_process_in_their_order(second):
    prepare_second_process(np.show_config)  # what it prints comes among no answers
    there, scaled = begun(os.getpid), begun(scale, np.arange(3.0), 2)
    assert there.get() == there.get() != os.getpid()
    np.testing.assert_array_equal(scaled.get(), [0, 2, 4])


def test_errors_and_warnings_come_where_the_result_is_asked_for(second):
    wrong, warned = begun(int, "x"), begun(warnings.warn, "careful", UserWarning)
    with pytest.raises(ValueError, match="invalid literal"):
        wrong.get()
    with pytest.warns(UserWarning, match="careful"):
        warned.get()


def test_an_error_can_be_asked_for_as_soon_as_it_is_known(second):
    Later(_beside.Call(scale, ("a", 1.5), {}), None).check()  # nobody has begun with it
    fine, wrong = beside(os.getpid), beside(scale, "a", 1.5)
    with pytest.raises(TypeError):
        while wrong.answer is None:
            time.sleep(0.01)
        wrong.check()
    fine.check()
    assert fine.get() != os.getpid()  # it was done before


def test_who_waits_computes_what_nobody_has_begun(second):
    long, last = begun(time.sleep, 0.3), beside(os.getpid)
    long.get()
    assert last.answer is not None and last.get() == os.getpid()


def test_a_process_that_is_idle_gets_what_is_begun_even_if_it_is_asked_for_at_once(second):
    begun(os.getpid).get()
    while not second._idle:
        time.sleep(0.01)
    assert beside(os.getpid).get() != os.getpid()


def test_what_is_wanted_last_is_held_until_the_caller_waits_and_is_no_work_for_it(second):
    last, first = behind(os.getpid), begun(os.getpid)
    while first.answer is None:
        time.sleep(0.01)
    assert last in second._held and last.answer is None
    begun(time.sleep, 0.2).get()
    while last.answer is None:
        time.sleep(0.01)
    assert last.get() == first.get() != os.getpid()


def test_of_what_is_wanted_last_the_last_call_is_taken_first_and_preparations_are_kept_back(second):
    prepare_second_process(np.show_config, last=True)
    earlier, later = behind(os.getpid), behind(os.getpid)
    prepared = second._held[-1]
    assert list(second._held) == [later, earlier, prepared] and prepared.answer is None
    begun(os.getpid).get()
    while prepared.answer is None:
        time.sleep(0.01)
    assert later.answer and earlier.answer and not second._held


def test_what_is_begun_comes_before_what_was_held(second):
    begun(time.sleep, 0.2)
    held, other = behind(time.sleep, 0.3), beside(os.getpid)
    assert other.get() == os.getpid()  # from here on the held one may be taken
    soon = begun(os.getpid)
    while soon.answer is None:
        time.sleep(0.01)
    assert held.answer is None and soon.get() != os.getpid()


def test_remarks_are_found_there_while_nobody_looks(second):
    remarks = Remarks(tuple)
    remarks.begin()
    later: Later = vars(remarks)["_find"].__self__
    while later.answer is None:
        time.sleep(0.01)
    assert remarks == ()
    begin_remarks(remarks)  # which are found
    begin_remarks(())


def test_what_is_wanted_last_and_nobody_has_begun_is_computed_by_who_wants_it(second):
    long, last = begun(time.sleep, 0.2), behind(os.getpid)
    assert last.get() == os.getpid() and long.answer is None


def test_what_a_process_does_not_finish_is_computed_here(second):
    lost, waiting = begun(end_elsewhere, os.getpid()), beside(os.getpid)
    assert lost.get() == waiting.get() == os.getpid()
    assert beside(scale, 2, by=3).get() == 6


def test_what_cannot_be_sent_is_computed_here(second):
    later = beside(lambda: 3)
    second._feeding.join(10)
    assert later.get() == 3


def test_it_ends_with_the_command(second):
    long = begun(time.sleep, 0.2)
    _beside.end_second_process()
    assert second._process.returncode is not None and not has_second_process()
    assert long.get() is None and beside(os.getpid).get() == os.getpid()


@pytest.mark.parametrize("why_not", ["one core", "off", "no command"])
def test_without_one_a_result_is_computed_when_it_is_asked_for(why_not, monkeypatch):
    monkeypatch.setattr(_beside, "available_cores", lambda: 1 + (why_not != "one core"))
    monkeypatch.setenv("JAXQUAD_SECOND_PROCESS", "off" if why_not == "off" else "on")
    if why_not == "no command":
        start_second_process()
    with allowed_second_process():
        if why_not != "no command":
            start_second_process()
        assert not has_second_process()
        asked = []
        later = beside(asked.append, 1)
        assert not asked and later.get() is None and later.get() is None and asked == [1]
    assert Later.known(5).get() == 5
