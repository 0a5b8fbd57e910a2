"""The report is one page that needs no network and says what is missing or broken."""

import dataclasses
import html.parser
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from monopart.geometry.errors import InputError
from monopart.toolkit import charts, report, report_images
from monopart.toolkit.environment import environment_facts

_VOID = {"meta", "link", "img", "br", "hr", "input"}


def _person(shift: int = 0) -> np.ndarray:
    image = np.zeros((96, 96, 3), np.float32)
    image[12:84, 40 + shift : 58 + shift] = (0.8, 0.5, 0.3)
    image[40:80, 42 + shift : 56 + shift] = (0.2, 0.3, 0.6)
    return image


@pytest.fixture
def data() -> report.ReportData:
    rows = [
        {
            "iteration": i,
            "seconds": 0.5 * i,
            "losses": {"mse": 0.1 / (1 + i), "consistency": 1e-4},
            "psnr": 15 + 0.1 * i,
            **({"val_psnr": 14 + 0.1 * i} if i % 25 == 0 else {}),
        }
        for i in range(100)
    ]
    scores = {"psnr": 29.764, "ssim": 0.9625, "lpips": None}
    return report.ReportData(
        title='actor <a> & "b"',
        capture={"frames": 100, "size": "96 × 96"},
        headline=[report.Headline("PSNR", 29.76, "dB"), report.Headline("LPIPS", None)],
        curves=rows,
        metrics={"novel_view": {"strict": {"full": scores}}},
        triples=[
            report.Triple(
                "camera B2, frame 0", "novel_view", torch.from_numpy(_person(1)), _person(), scores
            )
        ],
        turntable=[_person(s) for s in (-8, 0, 8)],
        timings=report.Timings({"training": 504.2, "evaluation": 61}, 0.42, 2.7, 2**31),
        skipping=[report.SkipRow("samples", 1000, 39, "no density there")],
        config={"seed": 0, "model": {"grid": {"levels": 16}}, "steps": [1, 2]},
        environment=environment_facts(),
        references=[report.ReferenceRow("Other method", 26.63, 0.943, None, 2810)],
    )


class _Page(html.parser.HTMLParser):
    """Checks that tags close in order, and keeps tags, attributes and text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> closes another tag"

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text.append(data)


def _parse(text: str) -> _Page:
    page = _Page()
    page.feed(text)
    page.close()
    assert page.open == []
    return page


def test_page_is_well_formed_and_loads_nothing(tmp_path, data):
    path = report.build_report(tmp_path, data)
    assert path == tmp_path / "report.html"
    text = path.read_text(encoding="utf-8")
    page = _parse(text)
    for tag, attributes in page.tags:
        for name in ("src", "srcset", "href", "poster", "data", "action", "xlink:href"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, name, value)
    assert not re.search(r"https?:|@import|url\(|fetch\(|XMLHttpRequest|import\(", text)
    anchors = {a["id"] for _, a in page.tags if a.get("id")}
    links = {a["href"][1:] for t, a in page.tags if t == "a" and a.get("href")}
    assert links and links <= anchors
    assert all(a.get("alt") for t, a in page.tags if t == "img")


def test_page_shows_the_numbers_and_escapes_text(data):
    page = _parse(report.report_html(data))
    text = " ".join(page.text)
    for expected in (
        'actor <a> & "b"',
        "29.76",
        "not measured",
        "not computed",
        "0.9625",
        "Other method",
        "46 min 50 s",
        "8 min 24 s",
        "3.9 %",
        "model.grid.levels",
        "2.00 GiB",
    ):
        assert expected in text, expected
    images = [a for t, a in page.tags if t == "img"]
    assert [a.get("data-kind") for a in images if a.get("data-kind")] == [
        "rendered",
        "truth",
        "error",
    ]
    assert len(images) == 6
    assert not any("went wrong" in t for t in page.text)


def test_empty_report_says_what_is_missing():
    page = _parse(report.report_html(report.ReportData("A run")))
    text = " ".join(page.text)
    assert not [t for t, _ in page.tags if t in ("img", "svg")]
    for expected in ("No turntable", "No held-out image", "Not evaluated", "No training log"):
        assert expected in text, expected


def test_broken_renders_are_explained_at_the_top(data):
    nan = _person()
    nan[40:50, 45:55] = np.nan
    triples = [
        report.Triple("black", "novel_view", _person() * 0, _person()),
        report.Triple("hole", "novel_view", nan, _person()),
        report.Triple("none", "novel_view", None, _person(), note="no pose for it"),
        report.Triple("small", "novel_view", _person()[:50], _person()),
        report.Triple("both black", "novel_view", _person() * 0, _person() * 0),
        report.Triple("flat", "novel_view", np.full((96, 96, 3), 0.5), _person()),
    ]
    rows = [*data.curves, {"iteration": 100, "seconds": 51, "losses": {"mse": float("inf")}}]
    broken = dataclasses.replace(data, triples=triples, curves=rows, warnings=["LPIPS <off>"])
    found = report.found_warnings(broken)
    assert len(found) == 6
    for sentence, expected in zip(
        found,
        ("'mse' is not finite in 1 of 101", "entirely black", "100 of 9216", "no pose", "size",
         "one flat colour"),
        strict=True,
    ):  # fmt: skip
        assert expected in sentence
    text = report.report_html(broken)
    page = _parse(text)
    assert text.index("LPIPS &lt;off&gt;") < text.index("<h1>")
    assert "7 things went wrong" in " ".join(page.text)
    assert sum(a.get("class") == "banner" for _, a in page.tags) == 3


def test_error_map_has_the_stated_scale():
    truth = np.zeros((2, 3, 3), np.uint8)
    rendered = np.zeros((2, 3, 3))
    rendered[0, 1] = 0.25
    rendered[0, 2] = 0.125
    rendered[1, 0] = np.nan
    colours = report_images.error_map(rendered, truth, gain=4).astype(int)
    assert colours[0, 0].sum() < 15  # no difference is (near) black
    assert colours[0, 1].sum() > 550  # 1 / gain is the brightest colour
    assert colours[0, 0].sum() < colours[0, 2].sum() < colours[0, 1].sum()
    assert colours[1, 0].tolist() == [255, 0, 255]
    with pytest.raises(InputError, match="size"):
        report_images.error_map(rendered, truth[:1])


def test_crop_keeps_the_haze_of_a_render():
    truth, hazy = _person(), _person()
    hazy[5, 90] = 0.2  # a stray speck far from the person must stay in view
    top, bottom, left, right = report_images.content_box([hazy, truth])
    assert top <= 5 < bottom and left <= 90 < right
    assert report_images.content_box([truth])[3] < 90


def test_chart_places_points_where_their_values_are():
    series = charts.Series("loss", [0, 5, 10], [1.0, 0.1, 0.01])
    text = charts.line_chart([series], title="Loss", x_label="s", y_label="", log_y=True)
    match = re.search(r'<polyline[^>]*points="([^"]+)"', text)
    assert match
    points = np.array([[float(v) for v in p.split(",")] for p in match[1].split()])
    np.testing.assert_allclose(np.diff(points[:, 0]), np.diff(points[:, 0])[0], atol=0.11)
    np.testing.assert_allclose(np.diff(points[:, 1]), np.diff(points[:, 1])[0], atol=0.11)
    assert points[0, 1] < points[-1, 1]  # larger values are higher up


@pytest.mark.parametrize("values", [[], [None], [float("nan")], [0.0], [-1.0]])
def test_chart_without_a_drawable_point_says_so(values):
    series = charts.Series("loss", list(range(len(values))), values)
    text = charts.line_chart([series], title="Loss", x_label="s", y_label="", log_y=True)
    assert "<svg" not in text
    assert "No drawable value logged for: loss" in text


def test_chart_of_many_points_keeps_its_spike():
    y = [1.0] * 5000
    y[1234] = 50.0
    text = charts.line_chart(
        [charts.Series("a", list(range(5000)), y)], title="", x_label="", y_label=""
    )
    match = re.search(r'<polyline[^>]*points="([^"]+)"', text)
    assert match
    points = [p.split(",") for p in match[1].split()]
    assert len(points) <= 500
    assert min(float(p[1]) for p in points) < 60


@pytest.mark.parametrize(
    ("low", "high"), [(0, 95), (3.3, 3.3), (-5, 5), (1e-5, 2e-5), (28.91, 29.03), (0, 0)]
)
def test_ticks_cover_the_range(low, high):
    ticks = charts.linear_ticks(low, high)
    assert ticks[0] <= low + 1e-12 and ticks[-1] >= high - 1e-12
    assert 2 <= len(ticks) <= 9
    assert len({charts.tick_label(t) for t in ticks}) == len(ticks)


@pytest.mark.parametrize(("low", "high"), [(1e-6, 3.0), (0.3, 0.31), (1, 1), (0.001, 0.001)])
def test_log_ticks_cover_the_range(low, high):
    ticks = charts.log_ticks(low, high)
    assert ticks[0] <= low * (1 + 1e-9) and ticks[-1] >= high * (1 - 1e-9)
    assert ticks == sorted(set(ticks)) and len(ticks) >= 2


def test_missing_run_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        report.build_report(tmp_path / "nowhere", report.ReportData("A run"))


# --- in a browser ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def chromium() -> str:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    found = os.environ.get("MONOPART_CHROMIUM") or next(filter(None, map(shutil.which, names)), "")
    if not found:
        pytest.skip("no Chromium found: install it or set MONOPART_CHROMIUM to check the report")
    return found


def _browse(chromium: str, page: Path, folder: Path) -> tuple[list[str], list[str], str]:
    """Open a page; returns console messages, requests other than the page, and the final DOM."""
    log = folder / "net.json"
    command = [
        chromium, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--disable-extensions", "--disable-default-apps", "--no-first-run",
        "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
        f"--user-data-dir={folder / 'profile'}", f"--log-net-log={log}",
        "--net-log-capture-mode=Everything", "--enable-logging=stderr", "--v=0",
        "--virtual-time-budget=2000", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    # The browser asks its maker's servers on its own; those requests carry no initiator.
    own, requests = "not an origin", set()
    for event in json.loads(log.read_text())["events"]:
        fields = event.get("params", {})
        url = fields.get("url", "")
        if url.startswith(("http", "ws", "ftp")) and fields.get("initiator", own) != own:
            requests.add(url)
    return console, sorted(requests), done.stdout


_PROBE = """
<script>window.addEventListener("load", () => {
  document.querySelector(".three img").click();
  const svg = document.querySelector(".chart svg"), box = svg.getBoundingClientRect();
  svg.dispatchEvent(new PointerEvent("pointermove",
    {clientX: box.left + box.width / 2, clientY: box.top + 50}));
  const result = document.createElement("pre");
  result.id = "probe";
  result.textContent = JSON.stringify({
    resources: performance.getEntriesByType("resource").map((e) => e.name)
      .filter((name) => !name.startsWith("data:")),
    broken: [...document.images].filter((i) => !(i.complete && i.naturalWidth)).length,
    open: document.querySelector("dialog").open,
    layers: document.querySelectorAll(".dstage img").length,
    tip: document.querySelector(".tip").textContent,
    wide: document.documentElement.scrollWidth > window.innerWidth,
  });
  document.body.append(result);
});</script>
"""


def test_page_opens_in_chromium_without_network_or_console_error(tmp_path, chromium, data):
    page = report.build_report(tmp_path, data)
    page.write_text(page.read_text(encoding="utf-8").replace("</body>", _PROBE + "</body>"))
    console, requests, dom = _browse(chromium, page, tmp_path)
    assert console == []
    assert requests == []
    match = re.search(r'<pre id="probe">(.*?)</pre>', dom, re.DOTALL)
    assert match, "the page's script did not run"
    probe = json.loads(html.unescape(match[1]))
    assert probe["resources"] == [] and probe["broken"] == 0 and not probe["wide"]
    assert probe["open"] and probe["layers"] == 2
    assert "mse" in probe["tip"]


def test_browser_check_notices_a_request_and_an_error(tmp_path, chromium):
    page = tmp_path / "bad.html"
    page.write_text('<!doctype html><img src="http://127.0.0.1:9/a.png"><script>missing()</script>')
    console, requests, _ = _browse(chromium, page, tmp_path)
    assert any("missing is not defined" in line for line in console)
    assert requests == ["http://127.0.0.1:9/a.png"]
