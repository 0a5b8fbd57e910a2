"""Run folders: made once, read back strictly, and what is saved renders the same."""

import json
import shutil
from types import SimpleNamespace

import pytest
import torch
from training import TINY

from monopart.geometry.errors import InputError
from monopart.toolkit.arguments import resolve
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.render import render_view
from monopart.toolkit.runs import check_free, create_run, next_free, open_run, read_facts
from monopart.toolkit.train import Trainer


@pytest.mark.parametrize("prior", [0, 200])
def test_what_is_saved_renders_bitwise_the_same(small_capture, tmp_path, prior):
    record = read_capture(small_capture)
    config = resolve("tiny", [[*TINY, f"field.prior_slope={prior}"]], iterations=3)
    run = create_run(tmp_path / "run", config, record)
    torch.manual_seed(config.seed)
    avatar = Avatar.create(record, config)
    fresh = render_view(avatar, view_of(record, 1, 0)).color
    Trainer(avatar, run).loop()
    loaded = open_run(run)
    assert loaded.config == config
    for camera, frame in ((0, 0), (1, 3)):  # a training frame, and a pose of no training frame
        kept = render_view(avatar, view_of(record, camera, frame))
        back = render_view(loaded, view_of(loaded.record, camera, frame))
        for name in ("color", "opacity", "depth"):
            assert torch.equal(getattr(kept, name), getattr(back, name)), name
        assert kept.stats == back.stats
    assert not torch.equal(fresh, render_view(loaded, view_of(record, 1, 0)).color), "trained"


@pytest.mark.parametrize(("clock", "steps"), [("wall", 2), ("cpu", 5)])
def test_a_budget_counts_the_clock_that_is_named(small_capture, monkeypatch, clock, steps):
    settings = [[*TINY, f"train.clock={clock}"]]
    config = resolve("tiny", settings, seconds=10.0)
    trainer = Trainer(Avatar.create(read_capture(small_capture), config), None)
    monkeypatch.setattr(trainer, "step", lambda step, done: {})
    # Another program has most of the machine: five seconds go by for two of work.
    wall = lambda: 5.0 * trainer.result.iterations  # noqa: E731
    work = lambda: 2.0 * trainer.result.iterations  # noqa: E731
    clocks = SimpleNamespace(perf_counter=wall, process_time=work)
    monkeypatch.setattr("monopart.toolkit.train.time", clocks)
    assert trainer.loop().iterations == steps


def test_names_of_new_runs(tmp_path):
    out = tmp_path / "demo"
    assert next_free(out) == out
    out.mkdir()
    assert next_free(out) == out, "an empty folder is free"
    (out / "x").write_text("")
    assert next_free(out) == tmp_path / "demo-2"
    (tmp_path / "demo-2").write_text("")
    assert next_free(out) == tmp_path / "demo-3"
    for path, found in ((out, "one with files"), (tmp_path / "demo-2", "a file")):
        with pytest.raises(InputError, match=f"found {found}; name another folder"):
            check_free(path)


def test_a_folder_that_cannot_be_made(small_capture, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot make the folder"):
        create_run(tmp_path / "file" / "run", resolve("tiny"), read_capture(small_capture))


@pytest.fixture
def run(trained_run, tmp_path):
    """A copy that may be changed."""
    return shutil.copytree(trained_run, tmp_path / "copy")


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("config.json", None, "expected a run folder with config.json, found none"),
        ("config.json", "{", "config.json: expected JSON"),
        ("config.json", '{"preset": "fast"}', "config.json: Config.*found no entry"),
        ("model.safetensors", None, "model.safetensors: expected trained weights, found no file"),
        ("model.safetensors", "broken", "model.safetensors: expected safetensors"),
        ("capture.json", None, "capture.json: expected the file .*name the capture by --capture"),
        ("capture.json", "[]", "capture.json: expected a JSON object, found list"),
        ("capture.json", "{}", "capture.json: expected texts path and params"),
        (
            "capture.json",
            '{"path": "/nowhere", "params": "new_params"}',
            "/nowhere: expected the capture of .*found nothing; name it by --capture",
        ),
    ],
)
def test_a_run_that_cannot_be_opened(run, file, content, words):
    (run / file).unlink()
    if content is not None:
        (run / file).write_text(content)
    with pytest.raises(InputError, match=words) as caught:
        open_run(run)
    assert "\n" not in str(caught.value)


def test_weights_of_another_configuration(run):
    path = run / "config.json"
    facts = json.loads(path.read_text())
    facts["field"]["log2_size"] += 1
    path.write_text(json.dumps(facts))
    with pytest.raises(
        InputError, match=r"model\.safetensors: expected the tensors of this config"
    ):
        open_run(run)


def test_a_body_of_other_texture_coordinates(run):
    path = run / "capture.json"
    facts = json.loads(path.read_text())
    assert len(facts["uv"]) == 64
    open_run(run)
    facts["uv"] = "0" * 64
    path.write_text(json.dumps(facts))
    with pytest.raises(InputError, match=r"other texture coordinates; name that body file"):
        open_run(run)


def test_a_capture_that_has_moved(run, small_capture):
    stored = {"path": "/nowhere", "params": "new_params"}
    (run / "capture.json").write_text(json.dumps(stored))
    assert open_run(run, small_capture).record.root == small_capture


def test_facts_that_are_missing(tmp_path):
    with pytest.raises(InputError, match="expected a file of a run, found none"):
        read_facts(tmp_path / "training.json")
