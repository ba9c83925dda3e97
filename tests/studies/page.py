"""Make docs/validation.md from the results of the studies: python tests/studies/page.py."""

import json
from pathlib import Path
from textwrap import fill

from healthy_table import shown
from result_files import FOLDER, tables


PAGE = Path(__file__).parents[2] / "docs" / "validation.md"
ORDER = (
    "healthy",
    "refined",
    "ringdown",
    "hold",
    "chirp",
    "nonlinearity",
    "coverage_short",
    "model_error",
    "tuned",
    "adrc",
)
HEAD = """\
# Validation

What a user gets without options, measured on plants whose truth is known. The page is made by
`python tests/studies/page.py` from the files in `tests/studies/results/`; each section names the
command that made its numbers. Plants and noise are simulated by NumPy and scipy alone, by code
that shares nothing with the library.
"""
TAIL = """\
## Numbers of others, and measured flights

- CIFER 6.3 printed a fit of a simulated Cessna's pitch rate to its elevator: gain, zero, pole and
  frequency of jaxquad agree with it within one standard error, the damping within 2.2
  ([Beside other tools](comparison.md), `python fits/cessna_navfit.py`).
- Five flights that others have published, among them a test stand, a Crazyflie and logs without
  any excitation: [Measured flights](measured.md) shows the commands and what they answer.
- The 29 equations of the paper, and its figures: [The paper's equations](equations.md),
  `python fits/paper.py`.
- Loops, margins and simulations equal python-control's and scipy's:
  [Beside other tools](comparison.md).
"""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *(_section(table) for name in studies() for table in _of(name)), TAIL])


def studies() -> list[str]:
    """Names of the results that there are, in the order of the page."""
    there = sorted(path.stem for path in FOLDER.glob("*.json"))
    return [name for name in ORDER if name in there] + [n for n in there if n not in ORDER]


def _of(name: str) -> list[dict]:
    return tables(json.loads((FOLDER / f"{name}.json").read_text()))


def _section(table: dict) -> str:
    rows = [table["columns"], ["---"] * len(table["columns"])]
    # [0][1] would be a link.
    rows += [[shown(cell).replace("[", "\\[") for cell in row] for row in table["rows"]]
    parts = [f"## {table['title']}", f"`{table['command']}`", fill(table.get("text", ""), 110)]
    parts += ["\n".join(f"| {' | '.join(row)} |" for row in rows)]
    notes = [fill(f"- {note}", 110, subsequent_indent="  ") for note in table.get("notes", ())]
    parts += ["\n".join(notes)]
    return "\n\n".join(part for part in parts if part) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
    print(PAGE)
