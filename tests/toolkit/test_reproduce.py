"""One command trains and scores the subjects that are there, and sets the paper's table beside."""

import json
from pathlib import Path

import pytest
from miniature import write_miniature
from public_miniature import ZJU, write_subject
from training import TINY

from monopart.geometry.errors import InputError
from monopart.toolkit import cli
from monopart.toolkit.captures.subjects import ON_TRAINING_CAMERA
from monopart.toolkit.published import published_scores
from monopart.toolkit.reproduce import find_subjects, page, tabulate


def _empty(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "annots.npy").touch()
    return folder


def test_subjects_are_found_by_the_names_of_their_folders(tmp_path):
    zju, cap = tmp_path / "zju", tmp_path / "all" / "monocap"
    expected = {"377": _empty(zju / "my_377"), "394": _empty(zju / "CoreView_394")}
    expected["vlad"] = _empty(cap / "vlad_images1011")
    _empty(zju / "my_390")
    stated = _empty(cap / "somebody")
    (stated / "capture.json").write_text('{"subject": "lan"}')
    expected["lan"] = stated
    found = find_subjects([zju, tmp_path / "all"])
    assert found == expected and list(found) == ["377", "394", "lan", "vlad"]
    assert list(find_subjects([zju, cap], ["vlad", "my_377"])) == ["377", "vlad"]
    assert find_subjects([zju / "my_377"]) == {"377": expected["377"]}


def test_what_is_not_found_is_named(tmp_path):
    _empty(tmp_path / "my_377")
    write_miniature(tmp_path / "x" / "my_386")  # its splits.json says that it is another capture
    with pytest.raises(InputError, match=r"such as 386 with annots.npy, found 377; name"):
        find_subjects([tmp_path], ["386"])
    with pytest.raises(InputError, match="expected a folder that holds subjects"):
        find_subjects([tmp_path / "absent"])
    with pytest.raises(InputError, match=r"DATA: expected folders such as my_377, my_386"):
        find_subjects([])
    with pytest.raises(InputError, match="expected one of 377"):
        find_subjects([tmp_path], ["390"])
    _empty(tmp_path / "copy" / "CoreView_377")
    with pytest.raises(InputError, match="expected one folder of subject 377, found also"):
        find_subjects([tmp_path])


def _scores(psnr: float, lpips: float | None, protocol: str = "legacy") -> dict:
    psnr = float(psnr)
    figures = {"psnr": psnr, "ssim": psnr / 100, "lpips": lpips}
    return {"novel_view": {protocol: {"full": figures}}}


FACTS = {
    "preset": "paper",
    "seed": 0,
    "images_per_split": None,
    "legacy_pixels": True,
    "seconds": {"377": 60.0, "386": 61.0, "olek": 62.0},
}


def test_means_are_over_the_subjects_of_a_data_set():
    scores = {"377": _scores(30, 0.04), "386": _scores(32, 0.03), "olek": _scores(34, None)}
    table = tabulate(scores, FACTS)
    assert table["protocol"] == "legacy"
    means = [row for row in table["rows"] if row["subject"] == "mean"]
    assert [(m["dataset"], m["subjects"], m["psnr"]) for m in means] == [
        ("zju_mocap", 2, 31.0),
        ("monocap", 1, 34.0),
    ]
    assert means[0]["lpips"] == pytest.approx(35) and means[1]["lpips"] is None
    text = page(table)
    assert "| MonoPartNeRF *(published)* | 32.12 | 0.972 | 35.50 | 6 min |" in text
    assert "| **mean of 2 of 6 subjects** *(measured)* | 31.00 | 0.310 | 35.00 | |" in text
    assert "| olek *(measured)* | 34.00 | 0.340 | – | 62 s |" in text
    assert "differ in kind" not in text


def test_another_protocol_and_a_selection_of_images_are_said():
    training = _scores(31, 0.1)["novel_view"]
    scores = {"377": {**_scores(30, 0.1, "strict"), ON_TRAINING_CAMERA: training}}
    table = tabulate(scores, {**FACTS, "images_per_split": 3, "legacy_pixels": False})
    assert table["protocol"] == "strict"
    text = page(table)
    assert "protocol `legacy`: the columns differ in kind" in text and "exact pixels" in text
    assert "Only 3 images of each split" in text


def test_published_figures_are_those_of_the_paper():
    best = {
        (s.dataset, s.split): (s.psnr, s.lpips)
        for s in published_scores()
        if s.method == "MonoPartNeRF"
    }
    assert best["zju_mocap", "novel_pose"] == (32.42, 29.05)
    assert best["monocap", "novel_view"] == (33.67, 14.87)


def test_the_command_trains_scores_and_goes_on(tmp_path, capsys, monkeypatch):
    write_subject(tmp_path / "data" / "my_392", ZJU)
    monkeypatch.setattr("monopart.toolkit.commands.STRIP_VIEWS", 2)
    out = tmp_path / "out"
    command = ["reproduce", str(tmp_path / "data"), "--out", str(out), "--iterations", "2"]
    command += ["--images", "2", "--set", *TINY, "loss.lpips=0"]
    assert cli.main(command) is None
    facts = json.loads((out / "392" / "capture.json").read_text())
    assert facts["subject"] == "392" and facts["legacy_pixels"] is True and facts["scale"] == 0.5
    table = json.loads((out / "table.json").read_text())
    splits = [r["split"] for r in table["rows"] if r["subject"] == "392"]
    assert splits == ["novel_view", "novel_pose", ON_TRAINING_CAMERA]
    assert all(row["psnr"] > 3 for row in table["rows"])
    assert capsys.readouterr().out.splitlines()[-1] == str(out / "table.md")
    before = (out / "392" / "model.safetensors").stat().st_mtime_ns
    assert cli.main(command) is None  # all there: nothing is trained again
    assert (out / "392" / "model.safetensors").stat().st_mtime_ns == before
    assert cli.main([*command, "--seed", "3"]) == 2
    assert "expected a run of this configuration" in capsys.readouterr().err
    training = out / "392" / "training.json"
    facts = json.loads(training.read_text())
    training.write_text(json.dumps({**facts, "warnings": ["Training was interrupted; the report"]}))
    assert cli.main(command) == 2
    assert "found one that was interrupted" in capsys.readouterr().err
    (out / "392" / "report.html").unlink()
    assert cli.main(command) == 2
    assert "found a broken one; remove the folder" in capsys.readouterr().err
