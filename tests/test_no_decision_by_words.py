"""No code decides by the words of a message: its `kind` says what it is about."""

import ast
from collections.abc import Iterator, Sequence

import pytest
from conftest import ROOT
from package_messages import nodes, PACKAGE


OF_JAX = ("_xla", "_compile")  # errors of JAX say by their text alone what they are
TEXTS = {
    "error",
    "message",
    "reason",
    "refusal",
    "remark",
    "remedy",
    "summary",
    "verdict",
    "warning",
}
MANY = {"doubts", "messages", "reasons", "remarks", "remedies", "unmodelled", "verdicts"}
LOOKS = {
    "count", "endswith", "find", "index", "removeprefix", "removesuffix", "replace",
    "rfind", "startswith",
}  # fmt: skip
MATCHES = {"findall", "finditer", "fullmatch", "match", "search", "split", "sub"}


def decisions(nodes: Sequence[ast.AST]) -> Iterator[ast.expr]:
    """Every expression that looks into the words of an error, a remark, a verdict or a remedy."""
    bound = {name for node in nodes for name in _bound_to_texts(node)}
    for node in nodes:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            looks = node.func.attr in LOOKS and _is_text(node.func.value, bound)
            matches = node.func.attr in MATCHES and any(_is_text(x, bound) for x in node.args)
            if looks or matches:
                yield node
        elif isinstance(node, ast.Compare):
            words, within = node.left, node.comparators[0]
            contains = isinstance(node.ops[0], ast.In | ast.NotIn)
            texts = _is_text(within, bound) or (_is_many(within) and _is_sentence(words))
            equal = _is_text(words, bound) and _is_sentence(within)
            if (contains and texts) or equal:
                yield node


def _bound_to_texts(node: ast.AST) -> Iterator[str]:
    """Names of caught errors, and of the items of remarks, reasons and the like."""
    if isinstance(node, ast.ExceptHandler) and node.name:
        yield node.name
    if isinstance(node, ast.comprehension | ast.For) and _is_many(node.iter):
        yield from (x.id for x in ast.walk(node.target) if isinstance(x, ast.Name))


def _is_many(node: ast.expr) -> bool:
    return _last_name(node) in MANY


def _is_text(node: ast.expr, bound: set[str]) -> bool:
    if isinstance(node, ast.Call) and _last_name(node.func) in ("str", "marked_text", "message_of"):
        return any(_is_text(each, bound) for each in node.args)
    if isinstance(node, ast.Subscript):  # error.args[0], remarks[0]
        owner = node.value
        return _is_many(owner) or (
            isinstance(owner, ast.Attribute)
            and owner.attr == "args"
            and _is_text(owner.value, bound)
        )
    name = _last_name(node)
    return name in TEXTS or (isinstance(node, ast.Name) and name in bound)


def _last_name(node: ast.expr) -> str:
    return node.id if isinstance(node, ast.Name) else getattr(node, "attr", "")


def _is_sentence(node: ast.expr) -> bool:
    if isinstance(node, ast.JoinedStr):
        return True
    return isinstance(node, ast.Constant) and " " in str(node.value)


def test_no_code_decides_by_the_words_of_a_message():
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}"
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.relative_to(PACKAGE).parts[0] not in OF_JAX
        for node in decisions(nodes(path))
    ]
    assert not found


@pytest.mark.parametrize(
    "code",
    [
        "any(x.startswith('no minimum') for x in fit.remarks)",
        "fit.verdict.summary.replace('no', 'NO')",
        "re.match('no', str(error))",
        "[_TERM.search(each) for each in verdict.reasons]",
        "'feedback' in fit.remarks[0]",
        "'the delay ran to zero' in fit.remarks",
        "remark == 'the delay ran to zero'",
        "try: f()\nexcept ValueError as why: g('scalar' in str(why), why.args[0].endswith('.'))",
    ],
)
def test_what_would_decide_by_words_is_seen(code):
    assert list(decisions([*ast.walk(ast.parse(code))]))


@pytest.mark.parametrize(
    "code",
    [
        "any(remark.kind == 'no minimum' for remark in fit.remarks)",
        "verdict.kind in ('no model', 'no minimum')",
        "name in verdict.undetermined",
        "' '.join(str(error).split())",
    ],
)
def test_what_decides_by_a_kind_is_allowed(code):
    assert not list(decisions([*ast.walk(ast.parse(code))]))
