"""Printed tables in a narrow terminal: all cells are there, and each row begins with its name."""

import io
import os
import sys

import pytest

from jaxquad.cli._options import fold_tables, print_text


TABLE = """\
on fresh plants      stable   worst Ms   resonance   crossover   delay margin   torque   noise
what flew            100.0 %      1.32      1.55        6.4 Hz      20.4 ms     1.00    1.00
a third of the way   100.0 %      1.37      1.42        8.3 Hz      16.2 ms     0.77    1.15"""
PROSE = "proposed: stable on all 256 fresh plants, worst Ms 1.47 of at most 1.8. " * 2


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("width", [40, 60, 80, 94])
def test_a_table_of_120_columns_fits_a_terminal_of_60(width):
    shown = fold_tables(f"{PROSE}\n\n{TABLE}\n{PROSE}", width).splitlines()
    assert shown[0] == shown[-1] == PROSE.rstrip("\n")  # a command in it can be copied
    rows = shown[2:-1]
    assert max(map(len, rows)) <= width
    names = ("on fresh plants", "what flew", "a third of the way")
    for name, line in zip(names, TABLE.splitlines(), strict=True):
        parts = [row.removeprefix(name) for row in rows if row.startswith(name)]
        assert " ".join(parts).split() == line.removeprefix(name).split()


def test_a_row_of_a_long_table_has_its_cells_together():
    rows = [f"channel{k:<3} {k:>12}  {k:>12}  {k:>12}" for k in range(40)]
    shown = fold_tables("\n".join(rows), 30).splitlines()
    assert max(map(len, shown)) <= 30
    for k, line in enumerate(shown):
        if line.startswith("channel7 "):
            assert "".join(shown[k : k + 3]).split() == ["channel7", "7", "7", "7"]


def test_a_name_that_is_wider_than_the_terminal_costs_no_cell():
    wide = "\n".join(f"{'channel' * 9}  {x}  {x}" for x in ("samples", "1234567"))
    assert fold_tables(wide, 30).split().count("1234567") == 2


def test_a_file_or_a_pipe_gets_tables_whole(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "60")
    print_text(TABLE)
    assert capsys.readouterr().out == f"{TABLE}\n"
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    print_text(TABLE)
    assert max(map(len, terminal.getvalue().splitlines())) <= int(os.environ["COLUMNS"])
