"""The frame of every page: what is allowed in it, how it looks, how it reaches the disk."""

import os
from pathlib import Path

from ._html_text import escaped, Html


STYLE = """
:root { color-scheme: light dark; --page: #fff; --text: #1c1f23; --soft: #57606a; --line: #d0d7de;
  --band: #f6f8fa; --link: #0550ae; --good: #116329; --warn: #7d4e00; --bad: #a40e26; }
@media (prefers-color-scheme: dark) {
  :root { --page: #16181c; --text: #e6e8eb; --soft: #a0a8b2; --line: #3a4048; --band: #1f2328;
    --link: #79b8ff; --good: #56d364; --warn: #e3b341; --bad: #ff8182; }
  figure img { filter: invert(0.915) hue-rotate(180deg); }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 1.2rem 1.2rem 3rem; background: var(--page);
  color: var(--text); font: 1rem/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif;
  overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0.2rem 0 0.4rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 0.6rem; padding-top: 0.6rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.4rem 0 0.4rem; }
p { margin: 0.5rem 0; max-width: 48rem; }
a { color: var(--link); }
.good { color: var(--good); } .warn { color: var(--warn); } .bad { color: var(--bad); }
.soft, figcaption, caption { color: var(--soft); font-size: 0.9rem; }
.verdicts { list-style: none; margin: 0.6rem 0; padding: 0; }
.verdicts li { border-left: 0.3rem solid currentColor; padding: 0.15rem 0.7rem; margin: 0.3rem 0;
  background: var(--band); }
.verdicts span { color: var(--text); }
.lead { font-size: 1.05rem; max-width: 52rem; }
.remarks { border: 1px solid var(--warn); border-radius: 0.3rem; margin: 0.8rem 0;
  padding: 0.5rem 1rem 0.5rem 2rem; max-width: 52rem; }
.remarks li { margin: 0.2rem 0; }
nav ul { display: flex; flex-wrap: wrap; gap: 0.2rem 1.1rem; list-style: none; padding: 0;
  margin: 0.8rem 0; }
figure { margin: 1rem 0; max-width: 48rem; }
figure img { display: block; max-width: 100%; height: auto; background: #fff; }
figcaption { margin-top: 0.3rem; }
.wide { overflow-x: auto; margin: 0.8rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.93rem; }
caption { text-align: left; padding-bottom: 0.3rem; }
th, td { padding: 0.25rem 0.8rem 0.25rem 0; border-bottom: 1px solid var(--line);
  text-align: left; vertical-align: top; font-weight: normal; overflow-wrap: normal; }
thead th { color: var(--soft); vertical-align: bottom; }
tbody th { min-width: 6.5rem; max-width: 22rem; overflow-wrap: anywhere; }
td { min-width: 6rem; max-width: 16rem; overflow-wrap: anywhere; }
.number { text-align: right; white-space: nowrap; min-width: 0; max-width: none; }
thead .number { white-space: normal; }
.high { font-weight: 600; color: var(--warn); }
pre { font: 0.85rem/1.4 ui-monospace, "DejaVu Sans Mono", monospace; margin: 0; padding: 0.6rem;
  background: var(--band); white-space: pre; overflow-wrap: normal; width: max-content;
  min-width: 100%; }
pre.wrap { white-space: pre-wrap; overflow-wrap: anywhere; width: auto; }
code { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: 0.9em; }
dl { display: grid; grid-template-columns: fit-content(16rem) 1fr; gap: 0.25rem 1rem;
  margin: 0.6rem 0; }
dt { color: var(--soft); } dd { margin: 0; min-width: 0; }
summary { cursor: pointer; color: var(--link); margin: 0.6rem 0; }
@media (max-width: 34rem) {
  body { padding: 0.8rem 0.8rem 2rem; }
  h1 { font-size: 1.3rem; }
  dl { grid-template-columns: 1fr; gap: 0; } dd { margin-bottom: 0.5rem; }
  th, td { padding-right: 0.6rem; }
}
@media print {
  :root { --page: #fff; --text: #000; --soft: #444; --line: #bbb; --band: #fff; --link: #000;
    --good: #0b4a1e; --warn: #5c3900; --bad: #7a0a1c; }
  @page { margin: 16mm; }
  body { max-width: none; padding: 0; font-size: 10pt; }
  nav, summary { display: none; }
  figure img { filter: none; }
  figure, table, .verdicts, .remarks { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  figure { max-width: 150mm; }
  .wide { overflow: visible; }
  pre { white-space: pre-wrap; width: auto; }
}
"""


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
