"""Make docs/validation.md and its tables from the studies: python tests/studies/page.py.

The page says of each study what it finds; each table is a CSV file in docs/validation/, and
notes.txt there holds what was simulated and what a study misses.
"""

import csv
import io
import re
from pathlib import Path
from textwrap import fill

from healthy_table import shown
from result_files import FOLDER, read


PAGE = Path(__file__).parents[2] / "docs" / "validation.md"
NOTES = "notes.txt"
ORDER = (
    "healthy",
    "new_ground",
    "refined",
    "ringdown",
    "hold",
    "feedthrough",
    "chirp",
    "nonlinearity",
    "coverage_short",
    "model_error",
    "posterior",
    "tuned",
    "adrc",
)
HEAD = """\
# Validation: do the error bars hold?

What a user gets without options, on plants of known truth. NumPy and scipy alone simulate them, by
code that shares nothing with the library ([what was simulated](validation/notes.txt)).
`python tests/studies/page.py` makes this page.
"""
SHORT = {  # columns of the first table that the page itself shows
    "plant": "plant",
    "coverage %, with model error": "95 % intervals hold, %",
    "rmse / bound, without luck": "error / least possible",
    "remarks %": "remarks, %",
}
FINDINGS = {
    "Healthy plants without options": """\
400 records of each plant (200 of three inputs), through `jq.frequency_response` and `jq.fit` with
their defaults. The least possible error is the Cramer-Rao bound; the luck of the draws is taken
out. Wanted: 93 to 97 %, at most 1.06 (coloured noise 1.10), at most 2 % of records with a remark.
scipy's `csd` and `least_squares` on the same records: 1.5 to 490 times the bound. Counting
model error widens intervals by 0 to 15 % where the model is right.
""",
    "New ground": """\
1000 plants drawn at random, seed 688949 (each run draws others): 95.2 % of the printed 95 %
intervals hold the truth, 18 % of records have a remark of the fit, most that the model has too many
parameters for the record, and of 8 % nothing is determined. No plant is a silent miss, by more than
4 claimed errors without a mark or remark (wanted: at most 0.2 %).
""",
    "Refinement in the time domain": """\
`jq.refine` reaches 0.92 to 1.05 times the bound with a noise model, in closed loop too. Output
error without one diverges in a closed loop; with the controller known (`loop=`) it has 3.2 to 7.1
times the bound.
""",
    "Ring-down at the end of a record": """\
A light mode still rings when the record ends: the worst error is 2.0 to 2.5 claimed errors in the
median record, 4.7 at most. With local fits alone it is 2.6 to 171 claimed errors, and up to
319 %. Six of nine settings then have remarks in 97 % of records or more; 3 rad/s at 5 % noise has
them in 5 %.
""",
    "The hold of a command": """\
A command is held for 0.02 s. With the hold stated, 93.5 to 98 % of the intervals hold the truth.
Not stated, parameters are biased by up to 90 claimed errors, and every record has a remark.
""",
    "A held command that passes directly": """\
Delays of 0 to 6 samples: 88 to 100 % of 60 intervals hold, the worst error is 3.6 claimed ones.
""",
    "Nonlinear actuators": """\
A deadband of 15 % or a saturation at 80 % is remarked in 100 % of records, a linear actuator in
none.
""",
    "Short records": """\
With Student's t, 93.8 to 95 % of intervals hold for one input and 10 to 66 s; 91.2 % for three
inputs and 20 s; 90.5 % for 8 lines over 4 periods.
""",
    "Intervals with model error": """\
1280 records of plants with one term that the model lacks: the gain's 95 % interval holds in 95.9
% (by noise alone in 37 %), that of lag + delay in 89.7 % (15.4 %). An echo, or a lead and lag
within the band, bends the phase as a lag does and cannot be seen: 70 %.
""",
    "Intervals of NUTS beside the default ones": """\
Ten plants, 100 records: of 290 intervals the default ones hold in 96.6 %, those of NUTS on
`fit.log_density`
in 94.5 %, with 0.99 times the width (median). They differ near zero: a delay that is 0 has 0.48 to
1.82 times the default width.
""",
    "Tuned designs, judged again": """\
Other code flies 2000 members of `tests/tuning_case.py`. None of a design by `jq.tune` is unstable
or beyond its limit Ms <= 3.6; the paper's gains leave 36 to 70 % unstable. With 95 % confidence
at most 1.2 % of all members exceed the worst of 256.
""",
    "ADRC parameters from a log, on the true plant": """\
200 simulated flights of a 5-inch quad. `propose_adrc` keeps Ms at most 1.8 in all; Ms exceeds the
worst certified value by at most 0.5 %. The guide's "b0 times two" keeps it too, with 58 % of the
bandwidth and 1.8 times the rate after a torque. The simulated plant has the model's structure.
""",
}
TAIL = """\
## Numbers of others, and measured flights

- CIFER (`python fits/cessna_navfit.py`), python-control and scipy: [Comparison](comparison.md).
- The paper's figures: [equations](equations.md), `python fits/paper.py`.
"""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *map(_section, studies()), TAIL])


def files() -> dict[str, str]:
    """Text of the files in docs/validation/ by name."""
    parts = [table for name in studies() for table in read(name)]
    made = {_file_name(table): _as_csv(table) for table in parts}
    return made | {NOTES: "\n".join(map(_notes, parts))}


def studies() -> list[str]:
    """Names of the results that there are, in the order of the page."""
    there = sorted(path.stem for path in FOLDER.glob("*.json"))
    return [name for name in ORDER if name in there] + [n for n in there if n not in ORDER]


def _file_name(table: dict) -> str:
    return re.sub(r"\W+", "_", table["title"].lower()) + ".csv"


def _as_csv(table: dict) -> str:
    text = io.StringIO()
    rows = [[shown(cell) for cell in row] for row in table["rows"]]
    csv.writer(text, lineterminator="\n").writerows([table["columns"], *rows])
    return text.getvalue()


def _notes(table: dict) -> str:
    title = table["title"]
    parts = [title, "=" * len(title), table["command"], "", fill(table.get("text", ""), 110)]
    parts += [fill(f"- {note}", 110, subsequent_indent="  ") for note in table.get("notes", ())]
    return "\n".join(parts) + "\n"


def _section(study: str) -> str:
    """What a study finds, and its tables."""
    table, *_ = found = read(study)
    title = str(table["title"])
    parts = [f"## {title}", fill(FINDINGS.get(title) or table.get("text", ""), 110)]
    if study == "healthy":
        places = [table["columns"].index(name) for name in SHORT]
        rows = [[*SHORT.values()], ["---"] * len(SHORT)]
        rows += [[str(row[k]).replace(" .. ", "..") for k in places] for row in table["rows"]]
        parts += ["\n".join(f"| {' | '.join(row)} |" for row in rows)]
    links = " ".join(f"[Table](validation/{_file_name(each)})" for each in found)
    parts += [f"{links}\n`{table['command']}`"]
    return "\n\n".join(part for part in parts if part) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
    PAGE.with_suffix("").mkdir(exist_ok=True)
    for name, text in files().items():
        (PAGE.with_suffix("") / name).write_text(text)
    print(PAGE)
