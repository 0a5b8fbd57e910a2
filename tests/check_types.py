"""Type-check the installed wheel: checkers cannot follow the folder mapping of an editable install.

Run by ``make lint`` as a script. The installed files are copied first, for pyright checks nothing
below ``site-packages``.
"""

import json
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import monopart.geometry

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Run pyright with the settings of pyproject.toml; looking at too few files fails as well."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pyright"]
    installed = Path(monopart.geometry.__file__).parents[1]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "monopart"
        for name in settings["include"]:
            shutil.copytree(installed / name, copy / name)
        settings["include"] = ["monopart"]
        (Path(folder) / "pyrightconfig.json").write_text(json.dumps(settings))
        pyright = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--outputjson"]
        done = subprocess.run(pyright, cwd=folder, capture_output=True, text=True, check=False)
        expected = len(list(copy.rglob("*.py")))
    try:
        report = json.loads(done.stdout)
    except json.JSONDecodeError:
        print(done.stdout, done.stderr, file=sys.stderr)
        return 1
    for item in report["generalDiagnostics"]:
        where = item["file"].split("/monopart/", 1)[-1]
        line = item["range"]["start"]["line"] + 1
        print(f"{where}:{line}: {item['severity']}: {item['message']} ({item.get('rule', '')})")
    summary = report["summary"]
    print(f"pyright: {summary['errorCount']} errors in {summary['filesAnalyzed']} installed files")
    return int(summary["errorCount"] > 0 or summary["filesAnalyzed"] < expected)


if __name__ == "__main__":
    raise SystemExit(main())
