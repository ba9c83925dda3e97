"""Types of arguments and results, checked on the first calls of each function in each test.

A search calls the same small functions some 10,000 times. To check all of these calls takes longer
than they do, and finds nothing that the first ones do not show.
"""

from beartype import beartype, BeartypeConf, BeartypeStrategy


CALLS = 10  # of each function that are checked in a test
_tests = 0  # that have begun in this process
_of_all_items = beartype(conf=BeartypeConf(strategy=BeartypeStrategy.On))


def begin_test():
    """Let all functions be checked again."""
    global _tests
    _tests += 1


def checked(function):
    """`function` for its checks only, as jaxtyping calls it: made when it is called first."""
    check, test, calls = None, 0, 0

    def check_first(*args, **kwargs):
        nonlocal check, test, calls
        if test != _tests:
            test, calls = _tests, 0
        if calls < CALLS:
            calls += 1
            check = check or _of_all_items(function)
            check(*args, **kwargs)

    return check_first
