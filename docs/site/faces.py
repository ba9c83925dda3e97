"""How the reference reads the package: the exports of a room, and the units in comments."""

import re
from typing import Any

import griffe


COMMENT = re.compile(r"#\s+(?!fmt:|type:|pyright:|noqa)(.+)$")


class Faces(griffe.Extension):
    """For `X as X` exports, and for fields whose meaning stands in a comment behind them."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """`from ._file import X as X` makes X public, as if `__all__` named it."""
        for room in pkg.modules.values():
            for face in (room, *(x for x in room.modules.values() if not x.is_alias)):
                aliases = [n for n, m in face.members.items() if m.is_alias and n[0] != "_"]
                face.exports = face.exports or aliases  # a room of one file has `__all__`

    def on_attribute_instance(self, *, attr: griffe.Attribute, agent: Any, **_: Any) -> None:
        """The comment behind a field or a constant becomes its docstring."""
        if attr.docstring or attr.lineno is None:
            return
        lines = agent.code.splitlines()[attr.lineno - 1 : attr.endlineno]
        found = COMMENT.search(lines[-1]) if lines else None
        if found:
            attr.docstring = griffe.Docstring(found[1], parent=attr, lineno=attr.endlineno)
