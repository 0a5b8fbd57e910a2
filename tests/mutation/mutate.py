"""Plant small numerical bugs one at a time, and see which the tests catch.

    python tests/mutation/mutate.py [--jobs 2] [--only TEXT] [--fresh] [--publish]

Each mutant of `mutants.py` is written into a scratch copy of the tree below ``runs/mutation``; the
test files named for it run there until the first failure. Where they see nothing, the whole folder
of their room and the property tests run too. Before that, all of these files must pass without a
mutant: a test that fails anyway catches nothing.

Results are kept in ``runs/mutation/results.json`` under a digest of the mutant, its file and its
tests, so that a run that was cut short goes on, and only what changed is run again. The exit code
is 1 where more mutants survive than `ALLOWED_TO_SURVIVE`, where one could not be run, or where the
unchanged tree fails.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import queue
import re
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(HERE.parent)]

from building import FOLDERS, tracked_files  # noqa: E402
from mutants import ALLOWED_TO_SURVIVE, MUTANTS, Mutant  # noqa: E402

LONGEST = 240  # seconds of the tests of a mutant: one that makes them hang is not caught
PAGE = ROOT / "docs" / "mutation.md"
AFTERWARDS = """
The slips were written down before any of them was run. The first run caught 37 of 39; two tests
were written for the others: `test_nothing_is_lost_around_a_speck_and_little_is_kept` (marks of the
shell half a voxel off, which the slack of ordinary triangles hid) and the depths in
`test_skipping_does_not_change_the_image`. The skew of K was seen by the property tests alone, and
the stale weights and the background of the target only by tests of something else: each now has a
test of its own in `tests/toolkit/test_losses.py`.
"""


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant.

    Attributes:
        verdict: "caught", "missed", "timeout" or "error" (the tests could not run).
        by: the first test that failed, or the last line that pytest wrote.
        seconds: wall-clock seconds.
    """

    verdict: str
    by: str
    seconds: float


class Workshop:
    """A copy of the tree in which mutants are planted."""

    def __init__(self, folder: Path, root: Path = ROOT) -> None:
        """Copy what git tracks."""
        self.folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        for source in _files_of(root):
            target = folder / source.relative_to(root)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
        (folder / ".path" / "monopart").mkdir(parents=True)
        for name in FOLDERS:
            if (folder / name).is_dir():
                (folder / ".path" / "monopart" / name).symlink_to(folder / name)

    def check(self) -> None:
        """Make sure that the copy is what Python imports."""
        code = "import monopart.geometry as g; print(g.__file__)"
        found = self._run([sys.executable, "-c", code], 60).stdout.strip()
        if Path(found).resolve() != (self.folder / "geometry" / "__init__.py").resolve():
            raise RuntimeError(f"expected the package of {self.folder}, found {found!r}")

    def try_mutant(self, mutant: Mutant) -> Outcome:
        """Plant one, run its tests, take it out."""
        place = self.folder / mutant.file
        text = place.read_text(encoding="utf-8")
        start = time.monotonic()
        place.write_text(planted(mutant, text), encoding="utf-8")
        try:
            outcome = self.run_tests(mutant.tests)
            if outcome.verdict == "missed":
                outcome = self.run_tests(self.others(mutant))
        finally:
            place.write_text(text, encoding="utf-8")
        return dataclasses.replace(outcome, seconds=round(time.monotonic() - start, 1))

    def others(self, mutant: Mutant) -> tuple[str, ...]:
        """The other test files of the room and of the properties."""
        rooms = {str(Path(test).parent) for test in mutant.tests} | {"tests/properties"}
        every = [
            f for room in sorted(rooms) for f in sorted((self.folder / room).glob("test_*.py"))
        ]
        names = (str(f.relative_to(self.folder)) for f in every)
        return tuple(n for n in names if n not in mutant.tests)

    def run_tests(self, tests: tuple[str, ...], first_only: bool = True) -> Outcome:
        """Run test files and judge the result."""
        options = ["-q", "--tb=line", "-p", "no:cacheprovider", *(["-x"] if first_only else [])]
        start = time.monotonic()
        limit = LONGEST if first_only else 10 * LONGEST
        try:
            done = self._run([sys.executable, "-m", "pytest", *options, *tests], limit)
        except subprocess.TimeoutExpired:
            return Outcome("timeout", f"no end within {limit} s", limit)
        return dataclasses.replace(
            judged(done.returncode, done.stdout), seconds=round(time.monotonic() - start, 1)
        )

    def _run(self, command: list[str], limit: float) -> subprocess.CompletedProcess[str]:
        path = str(self.folder / ".path")
        environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
        environment.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        return subprocess.run(
            command,
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )


def _files_of(root: Path) -> list[Path]:
    return tracked_files() if root == ROOT else [p for p in root.rglob("*") if p.is_file()]


def planted(mutant: Mutant, text: str) -> str:
    """The text with the bug in it.

    Raises:
        ValueError: the old text does not occur exactly once.
    """
    count = text.count(mutant.old)
    if count != 1:
        raise ValueError(
            f"mutant {mutant.name!r}: expected its text once in {mutant.file}, found it {count} "
            "times; the code has moved: state the slip anew in tests/mutation/mutants.py"
        )
    return text.replace(mutant.old, mutant.new)


def judged(code: int, output: str) -> Outcome:
    """What an exit code of pytest says: only a failed test (1) is a catch."""
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    last = (output.strip().splitlines() or ["nothing was written"])[-1]
    if code == 1 and failed:
        return Outcome("caught", failed[0], 0.0)
    return Outcome("missed" if code == 0 else "error", "" if code == 0 else last, 0.0)


def digest(mutant: Mutant) -> str:
    """Changes with the mutant, its file and its tests."""
    parts = [repr(mutant), *((ROOT / name).read_text() for name in (mutant.file, *mutant.tests))]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


class Results:
    """Outcomes by mutant, on disk after each one."""

    def __init__(self, path: Path, fresh: bool) -> None:
        """Read what an earlier run wrote."""
        self.path, self.lock = path, threading.Lock()
        self.known: dict[str, dict] = {}
        if path.is_file() and not fresh:
            self.known = json.loads(path.read_text(encoding="utf-8"))

    def get(self, mutant: Mutant) -> Outcome | None:
        """The outcome of a mutant whose file and tests have not changed; misses are tried anew."""
        row = self.known.get(mutant.name)
        if row is None or row["digest"] != digest(mutant) or row["verdict"] != "caught":
            return None
        return Outcome(row["verdict"], row["by"], row["seconds"])

    def put(self, mutant: Mutant, outcome: Outcome) -> None:
        """Remember an outcome."""
        with self.lock:
            row = {"digest": digest(mutant), **dataclasses.asdict(outcome)}
            self.known[mutant.name] = row
            self.path.write_text(json.dumps(self.known, indent=1) + "\n", encoding="utf-8")


def run_all(mutants: tuple[Mutant, ...], work: Path, jobs: int, results: Results) -> bool:
    """Try every mutant without a known outcome; False where the unchanged tree fails."""
    waiting = [m for m in mutants if results.get(m) is None]
    print(f"{len(mutants)} mutants, {len(mutants) - len(waiting)} known from before")
    if not waiting:
        return True
    shops: queue.Queue[Workshop] = queue.Queue()
    for i in range(min(jobs, len(waiting))):
        shops.put(Workshop(work / f"tree{i}"))
    shop = shops.get()
    shop.check()
    tests = tuple(dict.fromkeys(t for m in waiting for t in m.tests))
    plain = shop.run_tests(tests, first_only=False)
    shops.put(shop)
    print(f"without a mutant: {len(tests)} files in {plain.seconds:.0f} s {plain.by}", flush=True)
    if plain.verdict != "missed":
        return False

    def work_on(mutant: Mutant) -> None:
        own = shops.get()
        try:
            outcome = own.try_mutant(mutant)
        finally:
            shops.put(own)
        results.put(mutant, outcome)
        print(
            f"{outcome.verdict:8s}{outcome.seconds:6.1f} s  {mutant.name}  {outcome.by}", flush=True
        )

    with ThreadPoolExecutor(shops.qsize()) as pool:
        list(pool.map(work_on, waiting))
    return True


def table(results: Results) -> str:
    """All outcomes as a table."""
    lines = ["| file | slip | what | verdict | first test that failed |", "|---|---|---|---|---|"]
    for m in MUTANTS:
        row = results.known.get(m.name, {"verdict": "not run", "by": ""})
        by = row["by"].removeprefix("tests/").split("[")[0]
        lines.append(f"| `{m.file}` | {m.kind} | {m.name} | {row['verdict']} | `{by}` |")
    return "\n".join(lines)


def page(results: Results) -> str:
    """The page of the documentation."""
    caught = sum(results.known.get(m.name, {}).get("verdict") == "caught" for m in MUTANTS)
    return f"""# Mutation check

Do the tests see a small numerical bug? `python tests/mutation/mutate.py` plants {len(MUTANTS)} of
them, one at a time, in a copy of the tree (`tests/mutation/mutants.py`: signs, half pixels,
transposed matrices, wrong units, swapped axes, missing guards, stale values; in torch code and in
Warp kernels), and runs the tests that should see each. A mutant counts as caught only where a test
fails: one that hangs, or that keeps the tests from starting, does not count. At most
{ALLOWED_TO_SURVIVE} may survive, else the exit code is 1. Where the named tests see nothing, the
whole folder of the room and the property tests run before a mutant counts as missed.

The check takes 13 minutes on two cores and is not part of the suite; that every mutant still
applies to the code is (`tests/mutation/test_mutants.py`).

**{caught} of {len(MUTANTS)} caught.** Written by `python tests/mutation/mutate.py --publish`.

{table(results)}
{AFTERWARDS}"""


def main(arguments: list[str] | None = None) -> int:
    """Run the check; the exit code says whether enough were caught."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=2, help="trees and processes side by side")
    parser.add_argument("--only", default="", help="only mutants whose name or file has this text")
    parser.add_argument("--fresh", action="store_true", help="forget what earlier runs found")
    parser.add_argument("--publish", action="store_true", help="write docs/mutation.md at the end")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "mutation", help="scratch")
    asked = parser.parse_args(arguments)
    asked.work.mkdir(parents=True, exist_ok=True)
    chosen = tuple(m for m in MUTANTS if asked.only in m.name or asked.only in m.file)
    results = Results(asked.work / "results.json", asked.fresh)
    start = time.monotonic()
    sound = run_all(chosen, asked.work, asked.jobs, results)
    outcomes = [results.known.get(m.name, {}).get("verdict", "not run") for m in chosen]
    missed = [m.name for m, o in zip(chosen, outcomes, strict=True) if o != "caught"]
    minutes = (time.monotonic() - start) / 60
    print(f"{len(chosen) - len(missed)} of {len(chosen)} caught, {minutes:.1f} minutes", *missed)
    if asked.publish:
        PAGE.write_text(page(results), encoding="utf-8")
    broken = {"error", "timeout", "not run"} & set(outcomes)
    return int(not sound or bool(broken) or len(missed) > ALLOWED_TO_SURVIVE)


if __name__ == "__main__":
    sys.exit(main())
