"""House rules that no linter knows."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from building import ROOT, source_files, tracked_files

LONGEST = 400
LIBRARY = [p for p in source_files() if p.relative_to(ROOT).parts[0] in ("geometry", "fields")]
TEXT = (".py", ".md", ".toml", ".yml", ".yaml", ".txt", ".json", ".cfg", ".html", "")

Function = ast.FunctionDef | ast.AsyncFunctionDef


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _where(path: Path, node: ast.AST) -> str:
    return f"{_name(path)}:{getattr(node, 'lineno', 0)}"


def test_files_fit_in_400_lines() -> None:
    python = [p for p in tracked_files() if p.suffix == ".py"]
    long = {_name(p): n for p in python if (n := len(p.read_text().splitlines())) > LONGEST}
    assert not long


def test_no_bare_assert_in_the_source() -> None:
    found = [
        _where(p, node)
        for p in source_files()
        for node in ast.walk(_tree(p))
        if isinstance(node, ast.Assert)
    ]
    assert not found


CALLS_REFUSED = {
    "cuda": "device comes from the inputs",
    "breakpoint": "a debugger stop",
    "eval": "runs text",
    "exec": "runs text",
}


def _refused(node: ast.Call) -> str | None:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name == "cuda" or (isinstance(node.func, ast.Name) and name in CALLS_REFUSED):
        return f"{name}: {CALLS_REFUSED[name]}"
    owner = getattr(getattr(node.func, "value", None), "id", "")
    if owner in ("pickle", "torch") and name == "load" and not _weights_only(node):
        return f"{owner}.load runs what a file says"
    if owner == "pickle" and name == "loads":
        return "pickle.loads runs what a file says"
    for keyword in node.keywords:
        true = isinstance(keyword.value, ast.Constant) and keyword.value.value is True
        if true and keyword.arg in ("allow_pickle", "shell"):
            return f"{keyword.arg}=True"
    return None


def _weights_only(node: ast.Call) -> bool:
    return any(
        k.arg == "weights_only" and getattr(k.value, "value", None) is True for k in node.keywords
    )


def test_no_dangerous_or_device_calls_in_the_source() -> None:
    found = [
        f"{_where(p, node)} {why}"
        for p in source_files()
        for node in ast.walk(_tree(p))
        if isinstance(node, ast.Call) and (why := _refused(node))
    ]
    assert not found


@pytest.mark.parametrize(
    "line",
    ["x.cuda()", "np.load(p, allow_pickle=True)", "pickle.loads(b)", "torch.load(p)", "eval(s)"],
)
def test_the_rule_above_can_fail(line: str) -> None:
    (call,) = (n for n in ast.walk(ast.parse(line)) if isinstance(n, ast.Call))
    assert _refused(call)


def test_no_unfinished_marks() -> None:
    marks = re.compile(r"\b(TO" + r"DO|FIX" + r"ME|XX" + r"X|NotImplemented" + r"Error)\b")
    found = [_name(p) for p in tracked_files() if p.suffix == ".py" and marks.search(p.read_text())]
    assert not found


def _decorators(node: Function | ast.ClassDef) -> set[str]:
    return {ast.unparse(d).split("(")[0] for d in node.decorator_list}


def _public(body: list[ast.stmt], inside: str = "") -> Iterator[tuple[str, Function]]:
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from _public(node.body, f"{node.name}.")
        elif isinstance(node, Function) and not node.name.startswith("_"):
            if not {"wp.kernel", "wp.func", "overload"} & _decorators(node):
                yield inside + node.name, node


def _returns_a_value(node: Function) -> bool:
    return node.returns is not None and ast.unparse(node.returns) not in ("None", "NoReturn")


def _arguments(node: Function) -> list[str]:
    every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return [a.arg for a in every if a.arg not in ("self", "cls")]


def _lacks(name: str, node: Function, inside_kernels: bool) -> str | None:
    text = ast.get_docstring(node)
    if node.returns is None:
        return "return annotation"
    if not text:
        return "docstring"
    if "." in name or inside_kernels:  # one sentence may be enough
        return None
    if _returns_a_value(node) and not re.search(r"^(Returns|Yields):", text, re.MULTILINE):
        return "Returns:"
    if _arguments(node) and not re.search(r"^Args:", text, re.MULTILINE):
        return "Args:"
    missing = [
        a for a in _arguments(node) if not re.search(rf"^\s+\*?{a}\b.*:", text, re.MULTILINE)
    ]
    return f"Args: {missing}" if missing else None


@pytest.mark.parametrize("path", LIBRARY, ids=_name)
def test_public_functions_are_documented(path: Path) -> None:
    found = {
        f"{_where(path, node)} {name}": lack
        for name, node in _public(_tree(path).body)
        if (lack := _lacks(name, node, "kernels" in path.parts))
    }
    assert not found


@pytest.mark.parametrize("path", source_files(), ids=_name)
def test_modules_say_what_they_are(path: Path) -> None:
    assert ast.get_docstring(_tree(path))


FOREIGN = re.compile(
    r"(?<![\w.~/-])/(?:wo" + r"rk|ro" + r"ot|ho" + r"me|op" + r"t|tmp/ba" + r"sh)(?:/|\b)"
    r"|py" + r"pi\.org|files\.python" + r"hosted|download\.py" + r"torch|index" + r"-url",
)


def test_no_foreign_paths_or_registry_hosts() -> None:
    found = []
    for path in tracked_files():
        if path.suffix in TEXT and path.name != "LICENSE":
            text = path.read_text(encoding="utf-8", errors="replace")
            found += [f"{_name(path)}: {m[0]}" for m in FOREIGN.finditer(text)]
    assert not found


def test_the_tree_is_plain_files() -> None:
    tracked = tracked_files()
    assert not [_name(p) for p in tracked if p.is_symlink()]
    assert not [_name(p) for p in tracked if p.stat().st_size > 8e6]


def _config_fields() -> set[str]:
    classes = [n for n in _tree(ROOT / "toolkit" / "config.py").body if isinstance(n, ast.ClassDef)]
    return {
        item.target.id
        for node in classes
        if "dataclass" in " ".join(_decorators(node))
        for item in node.body
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)
    }


def test_every_config_field_is_read() -> None:
    """A field that nothing reads is a promise that nothing keeps."""
    read = {
        node.attr
        for path in source_files()
        for node in ast.walk(_tree(path))
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    fields = _config_fields()
    assert len(fields) >= 5
    assert not sorted(fields - read)


def test_constraints_pin_everything() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][\w.]*", pin) for pin in pins), pins
    assert "torch==2.13.0" in pins
    assert len({pin.split("==")[0].lower().replace("_", "-") for pin in pins}) == len(pins)
