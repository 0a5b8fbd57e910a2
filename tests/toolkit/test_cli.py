"""The program: what it writes, what it prints, how it refuses, what its help says."""

import difflib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from miniature import write_miniature
from test_bad_input import CASES
from training import TINY

from monopart.geometry.errors import MonopartError
from monopart.toolkit import arguments, cli, commands, video
from monopart.toolkit.config import from_json
from monopart.toolkit.protocols import SPLITS
from monopart.toolkit.train import Trainer

pytestmark = pytest.mark.usefixtures("short_strip")
SNAPSHOT = Path(__file__).parents[1] / "snapshots" / "cli_help.txt"
COMMANDS = ("train", "eval", "render", "turntable", "info", "demo")
COMMANDS += ("replay", "ablate", "reproduce")
FILES = {
    "config.json",
    "capture.json",
    "environment.json",
    "model.safetensors",
    "train.jsonl",
    "training.json",
    "metrics.json",
    "images_novel_view.csv",
    "images_novel_pose.csv",
    "images_novel_pose_training_camera.csv",
    "worst_novel_view.png",
    "worst_novel_pose.png",
    "worst_novel_pose_training_camera.png",
    "report.html",
}


def _refusal(capsys: pytest.CaptureFixture[str], *argv: str | Path) -> str:
    """The one line of an error, without its prefix."""
    capsys.readouterr()
    assert cli.main([str(a) for a in argv]) == 2
    seen = capsys.readouterr()
    assert not seen.out
    prefix = "monopart: error: "
    lines = seen.err.splitlines()
    assert len(lines) == 1 and lines[0].startswith(prefix), seen.err
    return lines[0].removeprefix(prefix)


def test_run_folder_is_complete(trained_run):
    assert {p.name for p in trained_run.iterdir()} == FILES
    config = from_json(trained_run / "config.json")
    assert (config.preset, config.train.iterations, config.train.rays) == ("tiny", 3, 128)
    rows = [json.loads(line) for line in (trained_run / "train.jsonl").read_text().splitlines()]
    assert rows
    for row in rows:
        assert {"iteration", "seconds", "losses", "psnr"} <= row.keys()
    facts = json.loads((trained_run / "training.json").read_text())
    assert facts["iterations"] == 3 and facts["seconds"] > 0 and facts["stages"]["training"] > 0
    assert facts["stats"]["rays"] >= 3 * 128
    assert {"what", "dense", "kept", "note"} == facts["skipping"][0].keys()
    page = (trained_run / "report.html").read_text(encoding="utf-8")
    assert "worst of split" in page and "rendering: rays" in page and "<title>small: run" in page


def test_metrics_have_the_agreed_form(trained_run):
    metrics = json.loads((trained_run / "metrics.json").read_text())
    assert metrics.keys() == set(SPLITS)
    for split in metrics.values():
        assert split.keys() == {"strict", "shape"}
        assert 0 < split["shape"]["full"]["mask_iou"] < 1
        assert split["strict"].keys() == {"full", "box", "silhouette"}
        for scores in split["strict"].values():
            assert scores.keys() == {"psnr", "ssim", "lpips"}
            assert 0 < scores["psnr"] < 60


def test_train_says_results_on_stdout_alone(small_capture, tmp_path, capsys):
    argv = ["train", small_capture, "--out", tmp_path / "r", "--preset", "tiny", "--images", "1"]
    tail = ["--iterations", "1", "--seed", "5", "--params", "new_params", "--set", *TINY]
    assert cli.main([str(a) for a in (*argv, *tail)]) is None
    seen = capsys.readouterr()
    lines = seen.out.splitlines()
    names = [f"{split}, {kind}" for split in SPLITS for kind in ("strict", "shape")]
    assert [line.split(":")[0] for line in lines] == [*names, "report"]
    assert "(1 images" in lines[0]
    assert Path(lines[-1].removeprefix("report: ")) == tmp_path / "r" / "report.html"
    assert "Training" in seen.err and "strict: full" not in seen.err
    assert from_json(tmp_path / "r" / "config.json").seed == 5
    assert "1 of 2 images were evaluated" in (tmp_path / "r" / "report.html").read_text()


def test_an_interrupt_keeps_what_was_trained(small_capture, tmp_path, capsys, monkeypatch):
    whole = Trainer.step

    def interrupted(self, step, done):
        if step == 2:
            raise KeyboardInterrupt
        return whole(self, step, done)

    monkeypatch.setattr(Trainer, "step", interrupted)
    argv = ["train", str(small_capture), "--out", str(tmp_path / "r"), "--preset", "tiny"]
    assert cli.main([*argv, "--images", "1", "--seconds", "600", "--set", *TINY]) == 130
    assert {p.name for p in (tmp_path / "r").iterdir()} == FILES
    assert json.loads((tmp_path / "r" / "training.json").read_text())["iterations"] == 2
    assert "Training was interrupted" in (tmp_path / "r" / "report.html").read_text()
    assert capsys.readouterr().err.endswith("monopart: interrupted\n")


def test_an_interrupt_before_the_first_step(small_capture, tmp_path, monkeypatch):
    def interrupted(self, step, done):
        raise KeyboardInterrupt

    monkeypatch.setattr(Trainer, "step", interrupted)
    argv = ["train", str(small_capture), "--out", str(tmp_path / "r"), "--set", *TINY]
    assert cli.main(argv) == 130
    assert not (tmp_path / "r" / "report.html").exists()


def test_demo_takes_the_next_free_name(small_capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(commands, "DEMO_VIEWS", 3)
    monkeypatch.setattr(commands, "DEMO_SIZE", 32)
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "kept.txt").write_text("x")
    argv = ["demo", "--out", str(tmp_path / "demo"), "--capture", str(small_capture)]
    assert cli.main([*argv, "--set", *TINY, "train.iterations=2", "train.seconds=none"]) is None
    run = tmp_path / "demo-2"
    assert {p.name for p in run.iterdir()} == FILES | {"turntable.mp4"}
    assert video.read_video_size(run / "turntable.mp4")[:2] == (3, (32, 32))
    seen = capsys.readouterr()
    assert seen.out.splitlines()[-1] == f"report: {run / 'report.html'}"
    assert [p.name for p in (tmp_path / "demo").iterdir()] == ["kept.txt"]


def test_demo_needs_its_capture(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = _refusal(capsys, "demo")
    assert "examples/capture" in message and "--capture" in message
    assert not (tmp_path / "runs").exists()


def test_render_and_turntable(trained_run, tmp_path, capsys):
    picture, film = tmp_path / "a.png", tmp_path / "a.mp4"
    argv = ["render", trained_run, "--camera", "Camera_B2", "--frame", "3", "--out", picture]
    assert cli.main([str(a) for a in (*argv, "--explain", "--coarse", "2", "--half")]) is None
    seen = capsys.readouterr()
    assert seen.out == f"{picture}\n"
    assert "rendering: rays" in seen.err and "What was skipped" in seen.err
    assert picture.stat().st_size > 0
    argv = ["turntable", trained_run, "--out", film, "--frames", "2", "--size", "32"]
    assert cli.main([str(a) for a in argv]) is None
    assert capsys.readouterr().out == f"{film}\n"
    assert video.read_video_size(film)[:2] == (2, (32, 32))


def test_info(trained_run, small_capture, capsys):
    assert cli.main(["info", str(small_capture)]) is None
    facts = json.loads(capsys.readouterr().out)
    assert facts["image_size"] == [48, 48] and facts["check"]["images"] == 3
    cache = facts["cache"]
    assert (
        cache["folder"] == os.environ["MONOPART_CACHE"] and cache["entries"] >= 2
    )  # images and shells; the tiny run has no prior
    assert cli.main(["info", str(trained_run)]) is None
    facts = json.loads(capsys.readouterr().out)
    assert facts["config"]["train"]["rays"] == 128 and "novel_view" in facts["metrics"]


@pytest.mark.parametrize("fault", CASES)
def test_a_fault_of_the_capture(tmp_path, capsys, fault):
    value, file, _, _ = CASES[fault]
    root = write_miniature(tmp_path / "capture", **{fault: value})
    message = _refusal(capsys, "train", root, "--out", tmp_path / "run")
    assert str(root / file) in message
    assert not (tmp_path / "run").exists(), "a run that cannot begin leaves nothing behind"


def test_a_pickle_that_runs_code(tmp_path, capsys):
    trap = tmp_path / "executed"
    root = write_miniature(tmp_path / "capture", evil_annots=trap)
    assert "annots.npy" in _refusal(capsys, "info", root)
    assert not trap.exists()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["train", "nowhere", "--out", "r"], "nowhere: expected the folder of a capture"),
        (["train", "c", "--out", "r", "--preset", "huge"], "expected one of .*tiny.*found 'huge'"),
        (["train", "c", "--out", "r", "--seconds", "1", "--iterations", "1"], "found both"),
        (["train", "c", "--out", "r", "--seconds", "0"], "--seconds: expected more than 0"),
        (["train", "c", "--out", "r", "--seconds", "nan"], "--seconds: expected more than 0"),
        (["train", "c", "--out", "r", "--iterations", "0"], "--iterations: expected at least 1"),
        (["train", "c", "--out", "r", "--images", "0"], "--images: expected at least 1"),
        (["train", "c", "--out", "r", "--seed", "-1"], "--seed: expected 0"),
        (["train", "c", "--out", "r", "--set", "train.rays=x"], "train.rays: expected whole numbe"),
        (["eval", "nowhere"], "nowhere: expected a run folder"),
        (["eval", "r", "--split", "train"], "--split: expected novel_view or"),
        (["render", "r", "--camera", "a", "--frame", "0", "--out", "a.jpg"], "ends in .png"),
        (["render", "r", "--camera", "a", "--frame", "0", "--out", "no/a.png"], "existing folder"),
        (["turntable", "r", "--out", "a.gif"], "ends in .mp4"),
        (["turntable", "r", "--out", "a.mp4", "--frames", "0"], "--frames: expected at least 1"),
        (["turntable", "r", "--out", "a.mp4", "--size", "2"], "--size: expected at least 16"),
        (["info", "nowhere"], "nowhere: expected the folder of a capture"),
    ],
)
def test_bad_arguments(tmp_path, capsys, monkeypatch, argv, words):
    monkeypatch.chdir(tmp_path)
    message = _refusal(capsys, *argv)
    assert re.search(words, message), message
    assert "; " in message, "the fix follows a semicolon"
    assert not list(tmp_path.iterdir())


def test_an_existing_run_folder(trained_run, small_capture, capsys):
    message = _refusal(capsys, "train", small_capture, "--out", trained_run)
    assert str(trained_run) in message and "name another folder" in message


def test_unknown_camera_frame_and_split(trained_run, tmp_path, capsys):
    out = tmp_path / "a.png"
    render = ["render", trained_run, "--out", out]
    assert "Camera_B1" in _refusal(capsys, *render, "--camera", "Camera_B9", "--frame", "0")
    assert "frame 77" in _refusal(capsys, *render, "--camera", "0", "--frame", "77")
    film = ["turntable", trained_run, "--out", tmp_path / "a.mp4"]
    assert "frame 77" in _refusal(capsys, *film, "--frame", "77")
    assert "nowhere" in _refusal(capsys, "eval", trained_run, "--capture", "nowhere")


@pytest.mark.parametrize("command", COMMANDS)
def test_arguments_that_do_not_parse(command, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main([command, "--no-such-option", "1"])
    assert caught.value.code == 2
    assert not capsys.readouterr().out


def test_a_message_of_many_lines_becomes_one(capsys, monkeypatch):
    def fail(argv):
        raise MonopartError("first\n  second")

    monkeypatch.setattr(arguments, "parse", fail)
    assert _refusal(capsys, "info", "x") == "first second"


def test_a_missing_extra_says_the_install_line(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tyro", None)
    monkeypatch.delitem(sys.modules, "monopart.toolkit.arguments")
    monkeypatch.delattr("monopart.toolkit.arguments")
    message = _refusal(capsys, "--help")
    assert (
        message
        == 'the package tyro is not installed; install it by pip install "monopart[toolkit]"'
    )


def _help(*argv: str) -> str:
    """Help in a fresh process of a fixed width."""
    code = (
        "import sys\nfrom monopart.toolkit import cli\n"
        "heavy = lambda: [m for m in ('torch', 'cv2', 'warp', 'kornia') if m in sys.modules]\n"
        "assert not heavy(), heavy()\n"
        f"for command in {argv!r}:\n"
        "    try:\n        cli.main([*command.split(), '--help'])\n"
        "    except SystemExit as done:\n        assert not done.code\n"
        "assert not heavy(), heavy()\n"
    )
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1", "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        check=False,
        env=environment,
        encoding="utf-8",
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_help_is_complete_and_imports_nothing_heavy():
    now = _help("", *COMMANDS)
    if os.environ.get("UPDATE_SNAPSHOTS"):
        SNAPSHOT.write_text(now, encoding="utf-8")
    kept = SNAPSHOT.read_text(encoding="utf-8")
    lines = difflib.unified_diff(kept.splitlines(), now.splitlines(), "kept", "now", "", "", 0)
    assert kept == now, "help has changed (UPDATE_SNAPSHOTS=1 rewrites it):\n" + "\n".join(lines)
    assert now.count("usage: monopart") == 1 + len(COMMANDS)


def test_the_installed_program(tmp_path):
    """The entry point: exit code and streams of the process itself."""
    code = "import sys; from monopart.toolkit.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, "info", str(tmp_path / "nowhere")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith("monopart: error: ") and done.stderr.count("\n") == 1


def test_every_preset_trains_and_resolves():
    for name in arguments.preset_names():
        config = arguments.resolve(name, seconds=12.5, seed=3)
        assert (config.preset, config.train.seconds, config.seed) == (name, 12.5, 3)
        assert arguments.resolve(name, iterations=7).train.seconds is None
