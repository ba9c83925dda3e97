"""The notebooks as pages of the site: their text, code and stored output, without running them."""

import json
import re
from pathlib import Path

from mkdocs.structure.files import File, Files


NOTEBOOKS = Path(__file__).parent.parent.parent / "notebooks"
LINK = re.compile(r"\]\(\.\./notebooks/(\w+)\.ipynb\)")


def on_files(files: Files, config) -> Files:
    """Add a page for each notebook."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        content = markdown(path)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=content))
    return files


def on_page_markdown(text: str, page, config, files) -> str:
    """Links from the pages to the notebooks lead to these pages."""
    return LINK.sub(r"](notebooks/\1.md)", text)


def markdown(path: Path) -> str:
    cells = json.loads(path.read_text())["cells"]
    text = "\n\n".join(part for cell in cells for part in parts(cell))
    return text.replace("](../docs/", "](../")


def parts(cell: dict) -> list[str]:
    """A cell of text as it is; a cell of code with what it printed and drew."""
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [source]
    printed = "".join(text for output in cell["outputs"] for text in output.get("text", []))
    drawn = [output["data"].get("image/png", "") for output in cell["outputs"] if "data" in output]
    return [
        f"```python\n{source}\n```",
        *([f"```text\n{printed}\n```"] if printed else []),
        *(f"![figure](data:image/png;base64,{''.join(image.split())})" for image in drawn if image),
    ]
