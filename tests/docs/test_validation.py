"""docs/validation.md and docs/validation/ are what the kept results of the studies say."""

import json
import sys

import jax
import numpy as np
import pytest
from conftest import ROOT


STUDIES = ROOT / "tests" / "studies"
sys.path.insert(0, str(STUDIES))  # tests/benchmarks has a page.py, too
from page import files, page, studies  # noqa: E402  # pyright: ignore


def test_the_page_and_its_tables_are_made_from_the_results():
    # Else: python tests/studies/page.py
    assert (ROOT / "docs" / "validation.md").read_text() == page()
    folder = ROOT / "docs" / "validation"
    assert {path.name: path.read_text() for path in folder.iterdir()} == files()


@pytest.mark.parametrize("name", studies())
def test_every_result_names_a_command_that_is_there(name):
    found = json.loads((STUDIES / "results" / f"{name}.json").read_text())
    for table in found if isinstance(found, list) else [found]:
        python, script, *_ = table["command"].split()
        assert python == "python" and (ROOT / script).is_file()
        assert all(len(row) == len(table["columns"]) for row in table["rows"])


def test_the_readme_and_the_site_lead_to_the_page():
    assert "docs/validation.md" in (ROOT / "README.md").read_text()
    assert "validation.md" in (ROOT / "mkdocs.yml").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["short-20", "trends", "jitter"])
def test_the_efficient_estimate_scatters_as_the_bound_says(name):
    """Without the library: the records' noise, through the weights of the bound alone."""
    from bounds import efficient  # pyright: ignore
    from plants import make  # pyright: ignore

    plant, count = make(name), 200
    best = efficient(plant)
    errors = np.array([best.errors(flown) for flown in plant.fly(np.arange(count))]) / best.bound
    # A scatter of 200 is known to 5 %, a mean to 7 % of the scatter.
    assert np.all(np.abs(np.std(errors, axis=0) - 1) < 0.2)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [20, 34, 784, 1661])
def test_a_global_model_does_not_miss_the_lag_of_a_short_record(seed):
    """Of these records linear estimates lead to growing poles: 1.2 to 2.5 bounds were lost."""
    from bounds import efficient  # pyright: ignore
    from healthy import identify  # pyright: ignore
    from plants import make  # pyright: ignore

    plant = make("short-20")
    best, (flown,) = efficient(plant), plant.fly(np.array([seed]))
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # as a user's
        found = identify(plant, flown)
    lost = found["values"] - plant.truth - best.errors(flown)
    assert np.all(np.abs(lost) < 0.7 * best.bound)


@pytest.mark.slow
def test_a_study_continues_where_it_stopped_and_makes_its_tables(tmp_path):
    from bounds import cramer_rao  # pyright: ignore
    from healthy import drawn, run  # pyright: ignore
    from healthy_table import as_tables  # pyright: ignore
    from plants import make  # pyright: ignore

    plant = make("short-20")
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # as a user's
        run("short-20", [0, 1], tmp_path)
        run("short-20", [0, 1, 2, 3, 4], tmp_path)
    rows = drawn(tmp_path / "short-20.jsonl")
    assert [row["seed"] for row in rows] == [0, 1, 2, 3, 4]
    bound = cramer_rao(plant)
    by_plant, by_parameter = as_tables(
        {"short-20": plant}, {"short-20": rows}, {"short-20": bound}, ""
    )
    assert by_plant["rows"][0][0] == plant.title
    errors = np.array([row["values"] for row in rows]) - plant.truth
    best = np.array([row["efficient"] for row in rows])
    assert np.all(np.abs(errors) < 6 * bound)
    # Most of an error is the records' own noise.
    assert np.all(np.abs(errors - best) < 3 * bound)
    assert len(by_parameter["rows"]) == plant.truth.size


def test_a_plant_of_new_ground_is_repeated_by_its_seed_and_number():
    from new_ground_plants import draw, true_combination  # pyright: ignore

    one, same, other = draw(5, 3), draw(5, 3), draw(6, 3)
    assert one.labels == same.labels != other.labels
    np.testing.assert_array_equal(one.record().outputs, same.record().outputs)
    truth = {"lag": 0.5, "delay": 0.25, "gain": -2.0}
    assert true_combination("lag + delay", ("lag", "delay"), truth) == 0.75
    assert true_combination("- lag + delay", ("lag", "delay"), truth) == -0.25
    assert true_combination("gain^2 / (lag delay)", (), truth) == 32.0


@pytest.mark.slow
def test_new_ground_continues_where_it_stopped_and_makes_its_tables(tmp_path):
    from new_ground import run, table  # pyright: ignore

    path = tmp_path / "drawn.jsonl"
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # as a user's
        run(5, range(1), 0, 1, path)
        run(5, range(3), 0, 1, path)
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert [row["plant"] for row in rows] == [0, 1, 2]
    plants, _ = table(rows, 5)
    assert plants["rows"][0][:2] == ["all", 3] and "--seed 5" in plants["command"]
