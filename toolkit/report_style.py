"""Style sheet and script of the report; both are written into the page."""

STYLE = """
:root{color-scheme:light dark;--bg:#fff;--panel:#f5f6f8;--ink:#14171c;--muted:#5c6570;
--line:#e2e5ea;--accent:#1f55c4;--warn-bg:#fff4e0;--warn-line:#e0a030;--warn-ink:#5b3a00;
--c1:#1f5fd0;--c2:#c85a00;--c3:#0b8457;--c4:#8340c0;--c5:#b81f5a;--c6:#5f6b00}
@media(prefers-color-scheme:dark){:root{--bg:#0f1115;--panel:#171a20;--ink:#e7eaef;--muted:#98a2af;
--line:#2a2f38;--accent:#8ab0ff;--warn-bg:#2b2110;--warn-line:#a8781f;--warn-ink:#ffd995;
--c1:#7aa8ff;--c2:#ff9d52;--c3:#4fd09d;--c4:#c79bff;--c5:#ff86b0;--c6:#c6d25a}}
*{box-sizing:border-box}
html{scroll-behavior:smooth;-webkit-text-size-adjust:100%}
body{margin:0;background:var(--bg);color:var(--ink);line-height:1.5;font-size:16px;
font-family:system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
.wrap{max-width:1160px;margin:0 auto;padding:0 24px}
h1,h2,h3,p,figure,dl,dd,ul{margin:0;padding:0}
h1{font-size:clamp(28px,5vw,46px);line-height:1.1;font-weight:650;letter-spacing:-.02em}
h2{font-size:24px;font-weight:650;letter-spacing:-.01em;margin-bottom:6px}
h3{font-size:16px;font-weight:600}
small,.small{font-size:13px}
h3 small{font-weight:400;color:var(--muted);margin-left:6px}
.lead{color:var(--muted);max-width:72ch;margin-bottom:20px}
section{padding:44px 0 0;scroll-margin-top:44px}
.warnings{background:var(--warn-bg);color:var(--warn-ink);border-bottom:2px solid var(--warn-line);
padding:14px 0}
.warnings ul{padding-left:20px}.warnings li{margin:4px 0}
.banner{background:var(--warn-bg);color:var(--warn-ink);border-left:3px solid var(--warn-line);
padding:8px 12px;margin:0 0 10px;font-size:14px;border-radius:0 4px 4px 0}
.hero{background:#0a0c10;color:#f2f4f8;padding:44px 0 0;color-scheme:dark}
.hero .eyebrow{color:#9aa4b2;font-size:14px;margin-bottom:8px}
.hero .sub{color:#aeb7c4;margin-top:10px;max-width:80ch}
.kpis{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:24px;
margin:30px 0 34px}
.kpis dt{font-size:13px;color:#9aa4b2}
.kpis dd{font-size:32px;font-weight:600;letter-spacing:-.02em;line-height:1.2;
font-variant-numeric:tabular-nums}
.kpis dd.text{font-size:20px;color:#aeb7c4;font-weight:500;line-height:1.9;letter-spacing:0}
.kpis dd span{font-size:15px;font-weight:500;margin-left:4px;color:#aeb7c4;letter-spacing:0}
.kpis dd.note{font-size:13px;font-weight:400;color:#7f8997;letter-spacing:0;line-height:1.4}
.strip{display:flex;overflow-x:auto;scrollbar-width:thin;justify-content:space-evenly}
.strip img{height:clamp(170px,25vw,320px);width:auto;flex:none;display:block}
.hero .caption{color:#7f8997;font-size:13px;padding-top:8px;padding-bottom:14px}
.hero .missing{border-color:#333a45;color:#aeb7c4;background:none;margin:24px 0 28px}
.hero .wrap>.missing:first-child{margin-top:0;transform:translateY(-14px);margin-bottom:8px}
nav{position:sticky;top:0;background:var(--bg);border-bottom:1px solid var(--line);z-index:2}
nav .wrap{display:flex;gap:22px;overflow-x:auto;scrollbar-width:none}
nav a{color:var(--muted);text-decoration:none;font-size:14px;padding:11px 0;white-space:nowrap}
nav a:hover,nav a:focus-visible{color:var(--ink)}
.missing{color:var(--muted);background:var(--panel);border:1px dashed var(--line);border-radius:6px;
padding:14px 16px}
.facts+.missing,.missing+.missing{margin-top:12px}
.triples{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(520px,100%),1fr));gap:30px}
.triple header{margin-bottom:8px}
.triple h3 small{margin-left:8px}
.scores{font-size:13px;color:var(--muted);font-variant-numeric:tabular-nums}
.scores b{color:var(--ink);font-weight:600;margin:0 12px 0 4px}.scores b:last-child{margin-right:0}
.three{display:grid;grid-template-columns:repeat(3,1fr);gap:4px}
.three figcaption{font-size:12px;color:var(--muted);margin-top:4px}
.three img,.three .missing{width:100%;display:block;border-radius:3px}
.three img{height:auto}
.worst{display:grid;grid-template-columns:repeat(auto-fill,minmax(300px,1fr));gap:12px}
.worst figure{margin:0}
.worst figcaption{font-size:12px;color:var(--muted);margin-top:4px}
.three .missing{aspect-ratio:.6;overflow:auto;font-size:13px;padding:10px}
.three.zooms img{cursor:zoom-in}
.three img:focus-visible,a:focus-visible,summary:focus-visible,button:focus-visible{
outline:2px solid var(--accent);outline-offset:2px}
.scale{display:inline-flex;align-items:center;gap:8px;font-size:13px;color:var(--muted);
font-variant-numeric:tabular-nums;margin-bottom:18px;flex-wrap:wrap}
.scale i{display:inline-block;width:140px;height:10px;border-radius:2px}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:15px}
th{font-weight:500;font-size:13px;color:var(--muted);text-align:left;vertical-align:bottom}
th,td{padding:8px 14px 8px 0;border-bottom:1px solid var(--line)}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
th:last-child,td:last-child{padding-right:0}
tr.ours td{font-weight:650}
td.none{color:var(--muted);font-size:13px}
td.name{white-space:nowrap}td.note{color:var(--muted);font-size:13px;min-width:160px}
h3.sub{margin:30px 0 4px}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(420px,100%),1fr));gap:32px}
.chart{position:relative}.chart svg{width:100%;height:auto;display:block;overflow:visible}
.legend{list-style:none;display:flex;flex-wrap:wrap;gap:2px 16px;font-size:13px;
color:var(--muted);min-height:22px;margin-bottom:4px}
.key{display:inline-block;width:14px;height:3px;border-radius:2px;margin-right:6px;
vertical-align:middle;background:var(--k)}
.line{fill:none;stroke:var(--k);stroke-width:2;stroke-linejoin:round}
.faint{opacity:.28;stroke-width:1}
.dot{fill:var(--k)}
.c1{--k:var(--c1)}.c2{--k:var(--c2)}.c3{--k:var(--c3)}.c4{--k:var(--c4)}.c5{--k:var(--c5)}
.c6{--k:var(--c6)}
.grid{stroke:var(--line)}.axis{stroke:var(--muted);opacity:.6}
.tick{fill:var(--muted);font-size:13px;font-variant-numeric:tabular-nums}
.cross{stroke:var(--muted);stroke-dasharray:3 3}
.tip{position:absolute;pointer-events:none;background:var(--ink);color:var(--bg);font-size:12px;
padding:4px 8px;border-radius:4px;white-space:pre;font-variant-numeric:tabular-nums;
transform:translate(-50%,-100%)}
.bar{background:var(--panel);height:8px;border-radius:2px;min-width:90px}
.bar i{display:block;height:100%;background:var(--c1);border-radius:2px;min-width:1px}
.facts{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(240px,100%),1fr));
gap:14px 28px}
.facts dt{font-size:13px;color:var(--muted)}.facts dd{font-variant-numeric:tabular-nums;
overflow-wrap:anywhere}
details{border-top:1px solid var(--line)}details:last-of-type{border-bottom:1px solid var(--line)}
summary{cursor:pointer;padding:12px 0;font-weight:600}
summary small{font-weight:400;color:var(--muted);margin-left:8px}
details table{font-size:14px;margin-bottom:16px}
details td:first-child{width:38%;color:var(--muted);vertical-align:top}
code,.mono{font-family:ui-monospace,SFMono-Regular,Menlo,Consolas,"Liberation Mono",monospace;
font-size:.9em;overflow-wrap:anywhere}
footer.wrap{color:var(--muted);font-size:13px;padding-top:44px;padding-bottom:36px}
dialog{border:0;padding:0;background:#0a0c10;color:#f2f4f8;max-width:none;max-height:none;
width:100vw;height:100vh;height:100dvh;color-scheme:dark}
dialog::backdrop{background:#000}
dialog[open]{display:flex;flex-direction:column}
.dbar{display:flex;gap:8px;align-items:center;padding:10px 16px;flex-wrap:wrap;font-size:14px}
.dbar strong{flex:1 1 180px;font-weight:600}
.dbar button{font:inherit;color:inherit;background:#1b2029;border:1px solid #333a45;
border-radius:5px;padding:6px 12px;cursor:pointer}
.dbar button[aria-pressed=true]{background:#f2f4f8;color:#0a0c10}
.dstage{flex:1;min-height:0;position:relative;margin:0 16px}
.dstage img{position:absolute;inset:0;width:100%;height:100%;object-fit:contain}
.dfoot{padding:10px 16px 16px;text-align:center;font-size:13px;color:#aeb7c4;min-height:64px}
.dfoot input{width:min(560px,100%);display:block;margin:0 auto 4px}
@media(max-width:600px){.wrap{padding:0 16px}.kpis{grid-template-columns:1fr 1fr;gap:18px}
.kpis dd{font-size:26px}section{padding-top:34px}.hero{padding-top:28px}.tick{font-size:16px}
th,td{padding-right:10px}}
@media print{nav{display:none}.hero{print-color-adjust:exact;-webkit-print-color-adjust:exact}
.triple,.chart{break-inside:avoid}}
"""

SCRIPT = """
"use strict";
(() => {
  const make = (tag, props, ...kids) => {
    const node = Object.assign(document.createElement(tag), props);
    node.append(...kids);
    return node;
  };
  const groups = [...document.querySelectorAll(".three")];
  if (groups.length) {
    const dialog = make("dialog", {});
    const title = make("strong", {}), stage = make("div", {className: "dstage"});
    const slider = make("input", {type: "range", min: 0, max: 100, value: 50});
    slider.setAttribute("aria-label", "Boundary between render and ground truth");
    const hint = make("span", {});
    const button = (text, act) => {
      const node = make("button", {type: "button", textContent: text});
      node.addEventListener("click", act);
      return node;
    };
    let at = 0, mode = "rendered";
    const find = (kind) => groups[at].querySelector(`img[data-kind=${kind}]`);
    const modes = {compare: "Compare", rendered: "Rendered", truth: "Ground truth",
      error: "Difference"};
    const buttons = Object.entries(modes).map(([name, text]) =>
      Object.assign(button(text, () => show(at, name)), {name}));
    const cut = () => {
      const top = stage.lastElementChild;
      if (mode !== "compare" || !top) return;
      const ratio = top.naturalWidth / top.naturalHeight;
      const width = Math.min(top.clientWidth, top.clientHeight * ratio);
      const left = (top.clientWidth - width) / 2 + width * slider.value / 100;
      top.style.clipPath = `inset(0 ${top.clientWidth - left}px 0 0)`;
    };
    const show = (index, wanted) => {
      at = (index + groups.length) % groups.length;
      const usable = Object.keys(modes).filter((name) =>
        find(name === "compare" ? "error" : name));
      mode = usable.includes(wanted) ? wanted : usable[0];
      buttons.forEach((node) => {
        node.hidden = !usable.includes(node.name);
        node.setAttribute("aria-pressed", node.name === mode);
      });
      title.textContent = groups[at].dataset.label;
      slider.hidden = mode !== "compare";
      hint.textContent = mode === "compare"
        ? "Left of the slider: rendered. Right of it: ground truth." : modes[mode] || "";
      const kinds = mode === "compare" ? ["truth", "rendered"] : mode ? [mode] : [];
      stage.replaceChildren(...kinds.map((kind) => {
        const image = find(kind);
        return make("img", {src: image.src, alt: image.alt, onload: cut});
      }));
      cut();
    };
    slider.addEventListener("input", cut);
    window.addEventListener("resize", cut);
    dialog.addEventListener("keydown", (event) => {
      if (event.target === slider) return;
      if (event.key === "ArrowRight") show(at + 1, mode);
      if (event.key === "ArrowLeft") show(at - 1, mode);
    });
    dialog.append(
      make("div", {className: "dbar"}, title, ...buttons,
        button("Previous", () => show(at - 1, mode)), button("Next", () => show(at + 1, mode)),
        button("Close", () => dialog.close())),
      stage, make("div", {className: "dfoot"}, slider, hint));
    document.body.append(dialog);
    groups.forEach((group, index) => {
      group.classList.add("zooms");
      group.querySelectorAll("img").forEach((image) => {
        const open = () => {
          dialog.showModal();
          show(index, image.dataset.kind === "error" ? "error" : "compare");
        };
        image.tabIndex = 0;
        image.setAttribute("role", "button");
        image.addEventListener("click", open);
        image.addEventListener("keydown", (event) => {
          if (event.key === "Enter" || event.key === " ") { event.preventDefault(); open(); }
        });
      });
    });
  }
  document.querySelectorAll(".chart svg").forEach((svg) => {
    const numbers = (name) => svg.dataset[name].split(" ").map(Number);
    const [left, top, right, bottom] = numbers("box"), [x0, x1] = numbers("x");
    const [y0, y1] = numbers("y"), log = svg.dataset.log === "1";
    const lines = [...svg.querySelectorAll("g[data-name]")].map((group) => ({
      name: group.dataset.name,
      points: [...group.querySelector("polyline:last-of-type").points],
    }));
    const cross = document.createElementNS(svg.namespaceURI, "line");
    cross.setAttribute("class", "cross");
    cross.setAttribute("y1", top);
    cross.setAttribute("y2", bottom);
    const tip = make("div", {className: "tip"});
    const leave = () => { cross.remove(); tip.remove(); };
    const value = (y) => {
      const share = (bottom - y) / (bottom - top);
      return log ? y0 * (y1 / y0) ** share : y0 + share * (y1 - y0);
    };
    svg.addEventListener("pointerleave", leave);
    svg.addEventListener("pointermove", (event) => {
      const box = svg.getBoundingClientRect(), scale = (right + 14) / box.width;
      const x = (event.clientX - box.left) * scale;
      if (x < left || x > right) { leave(); return; }
      const near = lines.map(({name, points}) => [name, points.reduce((best, point) =>
        Math.abs(point.x - x) < Math.abs(best.x - x) ? point : best)]);
      cross.setAttribute("x1", x);
      cross.setAttribute("x2", x);
      svg.append(cross);
      const time = x0 + (x - left) / (right - left) * (x1 - x0);
      tip.textContent = [`${time.toPrecision(3)} ${svg.dataset.unit}`,
        ...near.map(([name, point]) => `${name}  ${value(point.y).toPrecision(4)}`)].join("\\n");
      const home = svg.parentElement.getBoundingClientRect();
      const spot = Math.min(Math.max(event.clientX - home.left, 70), home.width - 70);
      tip.style.left = `${spot}px`;
      tip.style.top = `${box.top - home.top + top / scale - 2}px`;
      svg.parentElement.append(tip);
    });
  });
})();
"""
