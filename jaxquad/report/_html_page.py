"""The frame of every page: what is allowed in it, how it looks, how it reaches the disk."""

import os
from pathlib import Path

from ._html_style import STYLE
from ._html_text import escaped, Html


# No script runs and nothing is fetched, even if a text should get past the escaping.
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'"
)
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="jaxquad">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
{body}
</body>
</html>
"""


def page(title: str, body: Html) -> str:
    """A whole document; `title` is that of its tab."""
    return _PAGE.format(policy=escaped(_POLICY), title=escaped(title), style=STYLE, body=body)


def write_page(path: Path, text: str) -> Path:
    """By a draft beside it that takes its place once it is on the disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with draft.open("wb") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        return draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
