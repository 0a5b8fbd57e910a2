"""The public names and signatures of geometry and fields, against a snapshot.

Other methods build on these names. After a deliberate change: ``make snapshots``, and a line in
CHANGELOG.md.
"""

import ast
import difflib
import importlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from building import ROOT

SNAPSHOTS = Path(__file__).parent / "snapshots"
PACKAGES = ("geometry", "fields")


def _type_checking_names(tree: ast.Module) -> dict[str, str]:
    """Name → room of the imports that a type checker sees in an ``__init__``."""
    return {
        alias.name: str(node.module)
        for block in tree.body
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    }


def _function(node: ast.FunctionDef, indent: str = "") -> str:
    kinds = {ast.unparse(d) for d in node.decorator_list} & {
        "property",
        "classmethod",
        "staticmethod",
    }
    mark = "".join(f"@{k} " for k in sorted(kinds))
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"{indent}{mark}def {node.name}({ast.unparse(node.args)}){returns}"


def _class(node: ast.ClassDef) -> Iterator[str]:
    bases = ", ".join(ast.unparse(b) for b in node.bases)
    yield f"class {node.name}({bases})"
    for item in node.body:
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
            if not item.target.id.startswith("_"):
                yield "    " + ast.unparse(item)
        elif isinstance(item, ast.FunctionDef):
            if not item.name.startswith("_") or item.name in ("__init__", "__call__"):
                yield _function(item, "    ")


def _describe(package: str) -> str:
    lines: list[str] = []
    rooms = _type_checking_names(ast.parse((ROOT / package / "__init__.py").read_text()))
    for room in sorted(set(rooms.values())):
        lines.append(f"# {room}")
        tree = ast.parse((ROOT / package / f"{room}.py").read_text())
        for node in sorted(tree.body, key=lambda n: getattr(n, "name", "")):
            if rooms.get(getattr(node, "name", "")) != room:
                continue
            if isinstance(node, ast.FunctionDef):
                lines.append(_function(node))
            elif isinstance(node, ast.ClassDef):
                lines += _class(node)
        lines.append("")
    return "\n".join(lines)


@pytest.mark.parametrize("package", PACKAGES)
def test_signatures_are_kept(package: str) -> None:
    path, now = SNAPSHOTS / f"{package}.txt", _describe(package)
    if os.environ.get("UPDATE_SNAPSHOTS"):
        path.parent.mkdir(exist_ok=True)
        path.write_text(now)
    kept = path.read_text()
    change = "\n".join(
        difflib.unified_diff(kept.splitlines(), now.splitlines(), "kept", "now", "", "", 0)
    )
    assert not change, f"the public names changed; if this is meant: make snapshots\n{change}"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_there(package: str) -> None:
    module = importlib.import_module(f"monopart.{package}")
    for name in module.__all__:
        assert getattr(module, name).__name__ == name
    assert set(module.__all__) <= set(dir(module))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = module.nonsense


@pytest.mark.parametrize("package", PACKAGES)
def test_checkers_and_run_time_agree(package: str) -> None:
    """The names that a type checker sees are those that are there, from the same rooms."""
    module = importlib.import_module(f"monopart.{package}")
    seen = _type_checking_names(ast.parse((ROOT / package / "__init__.py").read_text()))
    assert seen == module._ROOM
    assert list(module.__all__) == sorted(module.__all__)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_public_name_is_a_room(package: str) -> None:
    """Importing a room of that name would replace the function."""
    rooms = {p.stem for p in (ROOT / package).glob("*.py")}
    module = importlib.import_module(f"monopart.{package}")
    assert not rooms & set(module.__all__)


def test_the_promised_names_are_there() -> None:
    """Names that other methods were promised."""
    from monopart import geometry
    from monopart.geometry.skinning import unskin

    promised = """
        axis_angle_to_rotmat rotmat_to_axis_angle rotmat_to_quat_wxyz quat_wxyz_to_rotmat
        rotation_angle KinematicTree forward_kinematics blend_transforms skin
        BodyModel BodyPose PosedBody
        SurfaceIndex SurfaceHit closest_point inverse_skin Unskinned UVMap PartMap Camera Rays
        BodyShell
        round_trip consistency_loss
    """
    assert set(promised.split()) <= set(geometry.__all__)
    assert callable(unskin)
