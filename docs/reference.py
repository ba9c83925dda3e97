"""Write the reference: `python docs/reference.py` prints docs/reference.md, with a folder, HTML.

HTML is made by pdoc (the extra `[docs]`), with warnings as errors.
"""

import importlib
import inspect
import re
import sys
import types
import warnings
from pathlib import Path
from typing import Any

import equinox as eqx
from jaxtyping import ArrayLike


ROOT = Path(__file__).parent.parent
ROOMS = {
    "records": "Read logs, cut, mix and resample records",
    "excitation": "Test signals",
    "design": "Design the test before it is flown",
    "spectra": "Frequency responses with their errors",
    "models": "Models and vehicles",
    "identify": "Identify, judge, verify",
    "qualities": "Handling qualities and margins",
    "control": "Controllers and inertia estimators",
    "loops": "The closed loop as a linear system",
    "simulate": "The closed loop in time",
    "tune": "Ensembles, tuning, certificates",
    "export": "Controllers as C",
    "report": "Figures, tables, reports",
    "batch": "Many logs",
}
HEAD = """# Reference

Every public name with the first line of its docstring; a name leads to its source.
`python docs/reference.py > docs/reference.md` writes this page, and a test holds it to the code.
Whole docstrings with signatures, shapes and units become HTML, from a bare clone, by

<!-- fragment -->
```sh
python3 -m venv .venv && .venv/bin/pip install -q ".[docs]"
.venv/bin/python docs/reference.py build/reference
```

A name is `jq.NAME` after `import jaxquad as jq`, unless it stands below "alone": then it comes
from its room, `from jaxquad.report import bode`.
"""


def public(module: Any) -> dict[str, Any]:
    """What a module exports, by name; in alphabetical order."""
    found = {n: v for n, v in vars(module).items() if not n.startswith("_")}
    kept = {n: v for n, v in found.items() if not inspect.ismodule(v)}
    return dict(sorted(kept.items(), key=lambda item: item[0].lower()))


def page() -> str:
    """The reference in Markdown."""
    top, parts = public(importlib.import_module("jaxquad")), [HEAD]
    for room, title in ROOMS.items():
        names = public(importlib.import_module(f"jaxquad.{room}"))
        shared = [line(room, n, v) for n, v in names.items() if n in top]
        alone = [line(room, n, v) for n, v in names.items() if n not in top]
        parts.append(f"## {title}: `jaxquad.{room}`\n\n")
        parts.append("".join(shared) + ("\n" if shared and alone else ""))
        parts.append(f"In `jaxquad.{room}` alone:\n\n{''.join(alone)}" if alone else "")
    return "\n".join(part.rstrip("\n") + "\n" for part in parts if part)


def line(room: str, name: str, value: Any) -> str:
    """One entry: of a type made of others, these."""
    made_of = isinstance(value, types.UnionType)
    text = f"`{legible(value)}`" if made_of else (inspect.getdoc(value) or "").split("\n")[0]
    value = inspect.unwrap(value)
    owner = value if inspect.isclass(value) or inspect.isfunction(value) else type(value)
    file = Path(inspect.getsourcefile(sys.modules[owner.__module__]) or "")
    home = file if file.is_relative_to(ROOT) else ROOT / "jaxquad" / room / "__init__.py"
    return f"- [`{name}`](../{home.relative_to(ROOT).as_posix()}): {text}\n"


def legible(annotation: Any, base_module: str | None = None, **_: Any) -> str:
    """A type as the code writes it, without the modules that it comes from."""
    plain, members = (_bare(_PLAIN(each)) for each in (annotation, ArrayLike))
    return plain.replace(members, "ArrayLike").replace(members[len("Union[") : -1], "ArrayLike")


def _bare(text: str) -> str:
    return re.sub(r"\b(?:[a-z_]\w*\.)+(?=[A-Za-z])", "", text)


_PLAIN = inspect.formatannotation


def write(folder: Path) -> None:
    """All rooms as HTML."""
    warnings.simplefilter("error")
    import pdoc.doc
    import pdoc.render

    eqx.Module.__module__ = "equinox"
    inspect.formatannotation = pdoc.doc.formatannotation = legible
    for room in ROOMS:
        module: Any = importlib.import_module(f"jaxquad.{room}")
        module.__all__ = list(names := public(module))
        for value in names.values():
            if inspect.isclass(value):
                pdoc.doc_ast.walk_tree(value).var_docstrings.update(comments(value))
    top: Any = importlib.import_module("jaxquad")
    parts = "".join(f"- `jaxquad.{room}`: {title}\n" for room, title in ROOMS.items())
    top.__all__, top.__doc__ = [], f"{top.__doc__}\n\n{parts}"
    pdoc.render.configure(docformat="markdown", show_source=False)
    pdoc.pdoc("jaxquad", *(f"jaxquad.{room}" for room in ROOMS), output_directory=folder)


def comments(owner: type) -> dict[str, str]:
    """Units and meanings that stand behind the fields of a class."""
    try:
        text = inspect.getsource(owner)
    except OSError:
        return {}
    return dict(re.findall(r"^    (\w+): .*?  # (.+)$", text, flags=re.M))


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))  # This clone, whatever is installed.
    write(Path(sys.argv[1])) if len(sys.argv) > 1 else print(page(), end="")
