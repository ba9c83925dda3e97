"""A table of text read by NumPy is the table, or the complaint, of reading it row by row."""

import numpy as np
import pytest
from hostile_files import damaged, sound_files

from jaxquad.records import ReadError
from jaxquad.records.formats import READERS


load = READERS["csv"].load
MODULE = "jaxquad.records.formats._tables"
ODD = (
    "1.5,nan,-inf,2e-7", "+1,.5,7.,0", " 3 ,\t4,5 , 6", "1e400,-1e400,1e-400,-0", "1,2,3", "1,,3,4",
    "1_0,2,3,4", '"1",2,3,4', "0x1,2,3,4", "1,2,3,4,", "n,2,3,4", "Infinity,NaN,INF,nAn",
    "# 1,2,3,4", "", "   ", "1 2,3,4,5", "1e,2,3,4", "--1,2,3,4", "1.2.3,2,3,4",
    "infinit,1,2,3", "e5,1,2,3",
    "0.1000000000000000055511151231257827,1.7976931348623157e308,4.9e-324,9007199254740993",
)  # fmt: skip


@pytest.fixture
def small_blocks(monkeypatch):
    """As a long file is read: in several blocks, each by NumPy where it can be."""
    monkeypatch.setattr(f"{MODULE}._BLOCK", 200)


def outcome(path):
    """Names and bits of the columns, or what was said."""
    try:
        columns = load(path).tables[""].columns
    except ReadError as error:
        return str(error), error.offset
    return {name: values.tobytes() for name, values in columns.items()}


def agree(path, monkeypatch):
    fast = outcome(path)
    with monkeypatch.context() as patch:
        patch.setattr(f"{MODULE}._parse", lambda *_: None)
        return fast == outcome(path)


@pytest.mark.parametrize("row", ODD)
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_odd_rows_are_what_they_are_row_by_row(tmp_path, monkeypatch, small_blocks, row, separator):
    plain = [",".join(map(str, each)) for each in np.arange(200).reshape(-1, 4) / 8]
    text = "\n".join(["t,a,b,c", *plain[:30], row, *plain[30:]])
    path = tmp_path / "odd.csv"
    path.write_text(text.replace(",", separator))
    assert agree(path, monkeypatch)


@pytest.mark.slow
def test_every_double_comes_back_bit_by_bit(tmp_path, monkeypatch):
    bits = np.random.default_rng(0).integers(0, 2**64, (20_000, 3), dtype=np.uint64)
    numbers = bits.view(np.float64)
    numbers[~np.isfinite(numbers)] = 1 / 3
    rows = [",".join(map(repr, row)) for row in numbers.tolist()]
    path = tmp_path / "doubles.csv"
    path.write_text("\n".join(["a,b,c", *rows]))
    monkeypatch.setattr(f"{MODULE}._parse_rows", lambda *_: pytest.fail("NumPy did not take it"))
    columns = load(path).tables[""].columns
    np.testing.assert_array_equal(np.stack(list(columns.values()), axis=1), numbers)


def test_damaged_tables_are_what_they_are_row_by_row(tmp_path, monkeypatch, small_blocks):
    _, content = sound_files(["csv"])["csv"]
    path = tmp_path / "damaged.csv"
    for number in range(300):
        path.write_bytes(damaged(content, np.random.default_rng([7, number])))
        assert agree(path, monkeypatch), number


def test_a_header_of_many_names_above_blank_lines_takes_no_memory(tmp_path):
    path = tmp_path / "wide.csv"
    names = ",".join(f"c{k}" for k in range(100_000))
    path.write_text(names + "\n" * 1_000_000)
    with pytest.raises(ReadError, match="only a header"):
        load(path)
